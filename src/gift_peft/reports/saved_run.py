"""What `gift-peft report` finds in a folder: a run, an evaluation, or (a YAML file) a planned run."""

import json
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gift_peft.evaluation.results import Report
from gift_peft.files import locate, portable_name, read_yaml

PLACES = {"model_name_or_path", "dataset_name", "base", "adapter", "dataset", "root"}  # in config.yaml, metrics.json


@dataclass
class SavedRun:
    """A run as it was saved.

    Args:
        path (`Path`): the folder or file it was read from.
        arguments (`dict`): config.yaml; empty for an evaluation alone.
        history (`list[dict]`): the rows of metrics.jsonl; empty before the base was measured.
        record (`dict`, *optional*): adapter/gift.json; None before an adapter was written.
        evaluations (`dict[str, Report]`): saved ones, by the name of their folder.
    """

    path: Path
    arguments: dict = field(default_factory=dict)
    history: list[dict] = field(default_factory=list)
    record: dict | None = None
    evaluations: dict[str, Report] = field(default_factory=dict)

    @property
    def adapter(self) -> Path | None:
        """The folder of the adapter with the smallest validation GCE, where there is one."""
        folder = self.path / "adapter"
        return folder if (folder / "adapter_config.json").is_file() else None

    @property
    def weights(self) -> tuple[float, float] | None:
        """(lambda_c, lambda_d), where the run has them."""
        if "lambda_c" not in self.arguments or "lambda_d" not in self.arguments:
            return None
        return float(self.arguments["lambda_c"]), float(self.arguments["lambda_d"])

    def best_row(self) -> dict | None:
        """The row of adapter/: of the smallest validation GCE, or what the run chose by (the base does not count).

        The last row where that was not measured.
        """
        metric = f"val_{self.arguments.get('metric_for_best_model', 'gce')}"
        rows = [row for row in self.history if row["step"] > 0]
        measured = [row for row in rows if row.get(metric) is not None]
        if measured:
            return min(measured, key=lambda row: row[metric])
        return rows[-1] if rows else None


def read_run(path: str | Path) -> SavedRun:
    """A run's folder, an evaluation's folder, or the YAML file of a planned run.

    Raises FileNotFoundError if it is none of these, ValueError naming a damaged file.
    """
    path = Path(path)
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return SavedRun(path, read_yaml(path))
    if (path / "metrics.json").is_file():
        return SavedRun(path, evaluations={path.name: Report.load(path)})
    if not ((path / "config.yaml").is_file() or (path / "metrics.jsonl").is_file()):
        raise FileNotFoundError(
            f"{path}: neither a run (config.yaml, metrics.jsonl), an evaluation (metrics.json) nor a YAML file of one"
        )
    run = SavedRun(path, read_yaml(path / "config.yaml") if (path / "config.yaml").is_file() else {})
    if (path / "metrics.jsonl").is_file():
        run.history = [_json(path / "metrics.jsonl", line) for line in _lines(path / "metrics.jsonl")]
        if any(not isinstance(row, dict) or "step" not in row or "epoch" not in row for row in run.history):
            raise ValueError(f"{path}/metrics.jsonl: every line needs step and epoch")
    record = path / "adapter" / "gift.json"
    if record.is_file():
        run.record = _json(record, record.read_text(encoding="utf-8"))
    for folder in sorted(child for child in path.iterdir() if (child / "metrics.json").is_file()):
        run.evaluations[folder.name] = Report.load(folder)
    for names in (run.arguments, *(report.about for report in run.evaluations.values())):
        _find_again(names, path)
    return run


def _find_again(names: dict, run: Path) -> None:
    """Point to where base, adapter and data are now, if the run was moved with them, and say so."""
    for key in PLACES & names.keys():
        found = locate(names[key], run) if isinstance(names[key], str) else None
        if found is not None and not Path(names[key]).exists():
            warnings.warn(f"{key} {names[key]}: taken from {found}", stacklevel=3)
            names[key] = str(found)


def run_names(runs: Sequence[SavedRun]) -> list[str]:
    """What each run is called in tables: its base, and where several share one the loss weights or else the folder."""
    bases, folders = [_base_name(run) for run in runs], folder_names(runs)
    names = list(bases)
    for index, (run, base) in enumerate(zip(runs, bases, strict=True)):
        others = [other for other, name in zip(runs, bases, strict=True) if name == base]
        if len(others) < 2:
            continue
        distinct = None not in (ratios := [other.weights for other in others]) and len(set(ratios)) == len(others)
        names[index] = f"{base} {ratio(run)}" if distinct else f"{base} ({folders[index]})"
    return names


def folder_names(runs: Sequence[SavedRun]) -> list[str]:
    """What each run is called in file names: its folder, with a number where several folders have one name."""
    names: list[str] = []
    for run in runs:
        number, name = 1, run.path.resolve().name
        while name in names:
            number += 1
            name = f"{run.path.resolve().name}-{number}"
        names.append(name)
    return names


def ratio(run: SavedRun) -> str:
    """The loss weights as the paper writes them, 1:1.5."""
    return ":".join(f"{weight:g}" for weight in run.weights)


def _base_name(run: SavedRun) -> str:
    name = run.arguments.get("model_name_or_path")
    for report in run.evaluations.values():
        name = name or report.about.get("base") or report.about.get("predictions")
    return portable_name(str(name)) if name else run.path.resolve().name


def _lines(path: Path) -> list[str]:
    return [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]


def _json(path: Path, text: str) -> dict:
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: not valid JSON: {error}") from None
