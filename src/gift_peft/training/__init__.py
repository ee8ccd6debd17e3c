"""Training: arguments, the loop, checkpoints, the teacher's proxies, the model card.

The loop is imported when it is first used, so that a wrong argument is told without waiting for torch.
"""

from gift_peft.training.arguments import GiftTrainingArguments, parse_arguments

__all__ = ["GiftTrainingArguments", "TrainResult", "parse_arguments", "train"]


def __getattr__(name: str):
    if name not in ("TrainResult", "train"):
        raise AttributeError(f"module 'gift_peft.training' has no attribute {name!r}")
    from gift_peft.training import loop

    return getattr(loop, name)
