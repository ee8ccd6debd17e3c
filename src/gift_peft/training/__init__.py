"""Training: arguments, the loop, checkpoints, the teacher's proxies, what goes with an adapter.

On one device, or on several that share each group (docs/several-gpus.md: torchrun, several machines, what is refused):

    gift-peft train --config run.yaml
    accelerate launch --multi_gpu --num_processes 4 -m gift_peft.training --config run.yaml

The loop is imported when it is first used, so that a wrong argument is told without waiting for torch.
"""

from gift_peft.training.arguments import GiftTrainingArguments, parse_arguments

__all__ = ["GiftTrainingArguments", "TrainResult", "parse_arguments", "train"]


def __getattr__(name: str):
    if name not in ("TrainResult", "train"):
        raise AttributeError(f"module 'gift_peft.training' has no attribute {name!r}")
    from gift_peft.training import loop

    return getattr(loop, name)
