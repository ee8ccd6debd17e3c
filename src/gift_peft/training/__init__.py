"""Training: arguments, the loop, checkpoints, the teacher's proxies, the model card.

One device:

    gift-peft train --config run.yaml

Several devices share each group: process r of W forwards and replays its micro-batches r, r+W, ..., predictions are
exchanged, gradients summed, and there is one update per group, as on one device. A group with fewer micro-batches than
processes leaves some waiting: a group of 10 in micro-batches of 2 keeps five busy. Proxies and validation are spread
by groups. Several GPUs of one machine, by either launcher:

    accelerate launch --multi_gpu --num_processes 4 -m gift_peft.training --config run.yaml
    torchrun --nproc_per_node 4 -m gift_peft.training --config run.yaml

Several machines: the same line on each with its own rank, and dataset, proxies and output_dir on a disk that all see.

    accelerate launch --multi_gpu --num_machines 2 --num_processes 8 --machine_rank 0 --main_process_ip 10.0.0.1 \\
        --main_process_port 29500 -m gift_peft.training --config run.yaml
    torchrun --nnodes 2 --nproc_per_node 4 --node_rank 0 --master_addr 10.0.0.1 --master_port 29500 \\
        -m gift_peft.training --config run.yaml

(`accelerate config` writes the same settings to a file once.) Two processes on a CPU:

    ACCELERATE_USE_CPU=true torchrun --nproc_per_node 2 -m gift_peft.training --config run.yaml

What does not work: FSDP, DeepSpeed and Megatron, because every process needs whole weights and the group step does its
own backward (refused); fp16 (refused); `accelerate launch --cpu --num_processes 2`, which starts one process where
there is no mpirun. If one process fails for itself, out of memory say, the launcher ends the others.

The loop is imported when it is first used, so that a wrong argument is told without waiting for torch.
"""

from gift_peft.training.arguments import GiftTrainingArguments, parse_arguments

__all__ = ["GiftTrainingArguments", "TrainResult", "parse_arguments", "train"]


def __getattr__(name: str):
    if name not in ("TrainResult", "train"):
        raise AttributeError(f"module 'gift_peft.training' has no attribute {name!r}")
    from gift_peft.training import loop

    return getattr(loop, name)
