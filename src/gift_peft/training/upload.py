"""What goes with an adapter: the record for gift.json, and the upload of adapter, record and card to the Hub.

The record holds no path of this machine; a local base or dataset appears by its folder's name only, as in the card
(`gift_peft.reports.model_card`).
"""

import platform
from pathlib import Path

import torch

from gift_peft.adapters.folder import ADAPTER_FILES, versions
from gift_peft.files import is_hub_id, portable_name
from gift_peft.training.arguments import FREE_TO_CHANGE, GiftTrainingArguments

# And all that a resumed run may not change.
RECORDED = ("model_revision", "dataset_name", "num_train_epochs", "max_steps", "retain")
RECORDED += ("per_device_train_batch_size", "gradient_accumulation_steps")
CPU = torch.device("cpu")


def run_record(args: GiftTrainingArguments, device: torch.device = CPU, **about) -> dict:
    """What was run, for gift.json: arguments, versions, kind of device, and `about` (size, metrics, fingerprint)."""
    arguments = {k: v for k, v in args.values().items() if k in RECORDED or k not in FREE_TO_CHANGE}
    arguments = {k: v for k, v in arguments.items() if v is not None and v != []}
    for name in ("model_name_or_path", "dataset_name"):
        arguments[name] = portable_name(arguments[name])
    machine = f"{platform.machine()} {device.type.upper()}"
    return {
        "arguments": arguments,
        "versions": versions(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else machine,
        **about,
    }


def check_push(args: GiftTrainingArguments) -> None:
    """Raise ValueError before training starts if the upload at its end could not work."""
    if not args.push_to_hub:
        return
    from huggingface_hub import get_token
    from huggingface_hub.utils import validate_repo_id

    if not is_hub_id(args.model_name_or_path):
        raise ValueError(
            "push_to_hub: model_name_or_path is a local folder, which nobody else could load; give the base's hub id"
        )
    if get_token() is None:
        raise ValueError("push_to_hub: no token; run `hf auth login` or set HF_TOKEN")
    try:
        validate_repo_id(_repository(args))
    except ValueError as error:
        raise ValueError(f"push_to_hub: {error} Give another --hub_model_id") from None


def _repository(args: GiftTrainingArguments) -> str:
    return args.hub_model_id or Path(args.output_dir).resolve().name


def push(folder: Path, args: GiftTrainingArguments) -> str:
    """Upload an adapter folder (its five files); returns the repository's id.

    OSError if that fails; the run itself is complete then, and resuming it uploads again.
    """
    from huggingface_hub import HfApi

    api = HfApi()
    try:
        repository = api.create_repo(repo_id=_repository(args), private=args.hub_private_repo, exist_ok=True).repo_id
        api.upload_folder(
            repo_id=repository,
            folder_path=folder,
            allow_patterns=sorted(ADAPTER_FILES),
            commit_message="GIFT adapter",
        )
    except (OSError, ValueError) as error:  # HfHubHTTPError is an OSError, a malformed repository name a ValueError
        raise OSError(
            f"push_to_hub: {error} (the adapter is in {folder}; the same command with "
            "--resume_from_checkpoint latest uploads it again)"
        ) from error
    return repository
