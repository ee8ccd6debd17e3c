"""Training: arguments, the loop, checkpoints, the teacher's proxies, the model card."""

from gift_peft.training.arguments import GiftTrainingArguments, parse_arguments
from gift_peft.training.loop import TrainResult, train

__all__ = ["GiftTrainingArguments", "TrainResult", "parse_arguments", "train"]
