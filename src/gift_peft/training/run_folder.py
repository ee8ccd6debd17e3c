"""What of an output folder a run has written, and so may replace, resume or delete; everything else there is kept.

A run is known by marks that nothing else leaves: the first line of its config.yaml, its adapters' gift.json, the
checksums of its checkpoints, the rows of its metrics.jsonl. Names alone say nothing: `config.yaml`, `logs/` and
`checkpoint-500/` are everybody's.
"""

import json
from pathlib import Path

import yaml

from gift_peft.adapters.folder import ADAPTER_FILES, GIFT
from gift_peft.files import check_replaceable, remove_files, remove_folder, strangers, write_whole
from gift_peft.training.arguments import GiftTrainingArguments, parse_arguments
from gift_peft.training.checkpoints import CHECKPOINT_FILES, CHECKSUMS, list_checkpoints

CONFIG, METRICS = "config.yaml", "metrics.jsonl"
ADAPTERS = ("adapter", "adapter-last")
MARK = "# Written by gift-peft train.\n"
ROW = {"step", "epoch", "loss", "train_gce"}
# As accelerate's tracker leaves them in `logs/`, where others may keep theirs.
TRACKED = ("gift-peft/events.out.tfevents.*", "gift-peft/*/events.out.tfevents.*", "gift-peft/*/hparams.yml")
FEWEST_ARGUMENTS = 15  # that a run's config.yaml states; somebody's own never has so many


def holds_run(output: Path) -> bool:
    """Whether a run has ever written here, finished or not."""
    return bool(_parts(output))


def check_folder(output: Path, args: GiftTrainingArguments) -> None:
    """Raise ValueError if the run could only write by replacing or deleting what no run of ours has written."""
    foreign = [folder for folder in _folders(output) if not _is_ours(folder)]
    unknown = [f"{folder.name}/" for folder in foreign if folder.is_file() or strangers(folder)]
    metrics = output / METRICS
    if metrics.exists() and not _is_metrics(metrics):
        unknown.append(METRICS)
    config = output / CONFIG
    if (
        config.exists()
        and not _is_config(config, holds_run(output))
        and not (holds_run(output) and _says_the_same(config, args))
    ):
        unknown.append(CONFIG)
    if unknown:
        raise ValueError(
            f"output_dir: {output} has {', '.join(unknown)}, which no run of gift-peft wrote (or which was changed by "
            f"hand since) and which a run there would replace: it is kept; name another folder, as {output / 'run'}"
        )
    for folder in _folders(output):
        check_replaceable(folder, CHECKPOINT_FILES if folder.name not in ADAPTERS else ADAPTER_FILES)


def write_config(output: Path, args: GiftTrainingArguments) -> None:
    """config.yaml, unless the one that is there says the same in other words, with comments perhaps."""
    config = output / CONFIG
    if not config.exists() or _is_config(config, holds_run(output)):
        write_whole(config, MARK + args.to_yaml())


def delete_run(output: Path) -> None:
    """What a run has written, and nothing else that may lie in the folder; `check_folder` comes before."""
    for path in _parts(output):
        if path.is_dir() and not path.is_symlink():
            remove_folder(path)
        else:
            path.unlink()
    logs = output / "logs"
    remove_files(output, [f"logs/{name}" for name in set(strangers(logs)) - set(strangers(logs, TRACKED))])


def _parts(output: Path) -> list[Path]:
    """The files and folders that bear a run's marks."""
    found = [folder for folder in _folders(output) if _is_ours(folder)]
    found += [path for path in [output / METRICS] if _is_metrics(path)]
    found += [path for path in [output / CONFIG] if _is_config(path, bool(found))]
    return found


def _folders(output: Path) -> list[Path]:
    """What has the name of a run's folder, whoever made it."""
    return [*(output / name for name in ADAPTERS if (output / name).exists()), *list_checkpoints(output)]


def _is_ours(folder: Path) -> bool:
    """Whether an adapter or checkpoint, perhaps a damaged one, is a run's."""
    if folder.name in ADAPTERS:
        return (folder / GIFT).is_file()
    return (folder / CHECKSUMS).is_file() or (folder / GIFT).is_file()


def _is_metrics(path: Path) -> bool:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        return json.loads(lines[0]).keys() >= ROW
    except (OSError, ValueError, AttributeError, LookupError):
        return False


def _is_config(path: Path, beside_a_run: bool) -> bool:
    """Whether a config.yaml is as a run writes it, to the letter: what was edited by hand is somebody's work.

    Runs before 0.2.0 left no mark; there what lies beside it tells.
    """
    try:
        text = path.read_text(encoding="utf-8")
        values = yaml.safe_load(text)
    except (OSError, ValueError, yaml.YAMLError):
        return False
    if not isinstance(values, dict) or not (text.startswith(MARK) or beside_a_run):
        return False
    dumped = yaml.safe_dump(values, sort_keys=False, allow_unicode=True)
    return len(values) >= FEWEST_ARGUMENTS and text.removeprefix(MARK) == dumped


def _says_the_same(config: Path, args: GiftTrainingArguments) -> bool:
    """Whether a config.yaml edited by hand gives the very run that is asked for."""
    try:
        return parse_arguments(["--config", str(config)]).to_yaml() == args.to_yaml()
    except (ValueError, OSError):
        return False
