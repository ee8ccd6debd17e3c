"""`gift-peft demo`: two objectives on a laptop. Embedded base and groups, training, evaluation, tables, a picture.

The paper's objective and the surface targets (training's `--target`) train one after the other and are shown side by
side. Everything goes through the code that real runs use; only the settings differ. The groups are rendered scenes
with true depth, and the base was pre-trained on rooms without a mirror or glass (`examples/tools/embedded/`).
"""

import filecmp
import os
import shlex
import shutil
from collections.abc import Sequence
from importlib.resources import as_file, files
from pathlib import Path

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.rows import parsed
from gift_peft.demo.side_by_side import markdown, panels, summary
from gift_peft.demo.validation_page import validation_page
from gift_peft.evaluation.evaluate import evaluate_references
from gift_peft.evaluation.results import Report
from gift_peft.files import read_yaml, strangers, whole_folder, write_whole
from gift_peft.models.loading import DepthModel
from gift_peft.options import use_color
from gift_peft.reports.figures import save_grid
from gift_peft.training import GiftTrainingArguments, train
from gift_peft.training.arguments import parse_arguments
from gift_peft.training.run_folder import check_folder, holds_run

SIZE = "112x140"
OUTPUTS = ("before_after.png", "validation.html", "report.md", "evaluation-proxy", "evaluation-depth")
# What differs from the paper's settings, because the model is 200 times smaller and the groups are fewer: so few
# updates need a high learning rate, which must fall for depths to settle, and less distillation to agree in time.
# While the rate is high the predictions agree best where they have also moved most outside the target, so no epoch
# before the last may be chosen. Found on the training groups and on validation groups that are not shipped.
SETTINGS = ["--num_train_epochs=4", "--learning_rate=2e-4", "--lr_scheduler_type=linear", "--lambda_d=0.9"]
SETTINGS += ["--eval_delay=4", "--checkpoints_total_limit=1", "--license=apache-2.0"]
# What each objective adds. Most groups go through in one forward of 4. Six fills of each photo would take longer than
# the training.
OBJECTIVES = {
    "consensus": ["--micro_batch_size=4"],
    "surface": ["--target=surface", "--fills=0", "--flip"],
}
LABELS = {"consensus": "paper's objective", "surface": "surface targets"}


def run_demo(
    out: str | Path = "demo",
    overwrite_output_dir: bool = False,
    seed: int = 0,
    target: str | None = None,
    extra: Sequence[str] = (),
) -> dict[str, dict[str, Report]]:
    """Trains, evaluates and writes `out`; returns {target: {"proxy" and "depth": report}}.

    Args:
        out: gets `base/`, `gift-i/` (parquet shards, proxies beside them), `report.md`, `before_after.png`,
            `validation.html`, and of the first run `adapter/` (naming the base by the path out/base),
            `metrics.jsonl`, `evaluation-proxy/` and `evaluation-depth/`; the second has the same in `surface/`.
        overwrite_output_dir: delete the runs that `out` holds.
        seed: of the LoRA initialisation and the order of the groups.
        target: "consensus" or "surface"; default both, one after the other.
        extra: training arguments that win over the demo's, as on the command line (`--lambda_d=0`).

    Raises:
        ValueError: `out` holds a run already, or files in the demo's way that no demo wrote, or an argument is wrong.
    """
    out = Path(out).expanduser()
    targets = [target] if target else list(OBJECTIVES)
    runs = {name: out if name == targets[0] else out / name for name in targets}
    arguments = {name: _arguments(name, out, run, overwrite_output_dir, seed, extra) for name, run in runs.items()}
    for run, args in zip(runs.values(), arguments.values(), strict=True):
        if holds_run(run) and not overwrite_output_dir and not args.resume_from_checkpoint:
            raise ValueError(
                f"out: {run} already holds a run; --resume_from_checkpoint latest goes on with it, "
                "--overwrite_output_dir deletes it, --out names another folder"
            )
        check_folder(run, args)
        if not _holds_demo(run) and (there := [name for name in OUTPUTS if (run / name).exists()]):
            raise ValueError(
                f"out: {run} has {', '.join(there)}, which no demo wrote: it is kept; --out names another folder"
            )
    earlier = _holds_demo(out)
    for name in ("base", "gift-i"):
        _copy_embedded(name, out / name, earlier)
    for number, (name, args) in enumerate(arguments.items(), 1):
        if len(arguments) > 1:
            print(f"Training {number} of {len(arguments)}: {LABELS[name]}", flush=True)
        if train(args, resume_command=_resume_command(out, seed, target, extra)).signal:
            raise KeyboardInterrupt

    groups = parsed(load_gift_i(out / "gift-i", "validation"))
    models = {name: DepthModel.from_pretrained(out / "base", run / "adapter") for name, run in runs.items()}
    reports = {name: _evaluate(model, groups, out, runs[name], seed) for name, model in models.items()}
    shown = {LABELS[name]: reports[name] for name in reports}
    pictures = panels(groups, shown, {LABELS[name]: model for name, model in models.items()})
    save_grid(pictures, ("RGB", "true depth", "base", *shown), out / "before_after.png")
    write_whole(out / "validation.html", validation_page(groups))
    write_whole(out / "report.md", markdown(shown, {LABELS[name]: args for name, args in arguments.items()}))
    print(summary(shown, color=use_color()))
    print(
        f"\nPicture  {out}/before_after.png\nReport   {out}/report.md\n"
        + "".join(f"Adapter  {run}/adapter ({LABELS[name]})\n" for name, run in runs.items())
        + "\nUse it:  from transformers import AutoModelForDepthEstimation\n"
        f'         model = AutoModelForDepthEstimation.from_pretrained("{out}/adapter")'
    )
    return reports


def _arguments(
    target: str, out: Path, run: Path, overwrite: bool, seed: int, extra: Sequence[str]
) -> GiftTrainingArguments:
    """Of one run; ValueError where `extra` replaces what the demo brings itself."""
    own = [f"--model_name_or_path={out}/base", f"--dataset_name={out}/gift-i", f"--output_dir={run}"]
    own += [f"--size={SIZE}", f"--seed={seed}", *SETTINGS, *OBJECTIVES[target]]
    if overwrite:
        own.append("--overwrite_output_dir")
    args = parse_arguments([*own, *extra])
    brought = {"model_name_or_path": f"{out}/base", "dataset_name": f"{out}/gift-i", "output_dir": run}
    for name, value in brought.items():
        if Path(getattr(args, name)) != Path(value):
            raise ValueError(f"{name}: the demo has its own; choose the folder with --out, or use `gift-peft train`")
    return args


def _evaluate(model: DepthModel, groups, out: Path, run: Path, seed: int) -> dict[str, Report]:
    """Against the proxies and against true depth; both are written into the run's folder."""
    reports = evaluate_references(groups, model)
    for reference, report in reports.items():
        report.about = {"base": f"{out}/base", "adapter": f"{run}/adapter", "dataset": f"{out}/gift-i", "seed": seed}
        report.save(run / f"evaluation-{reference}")
    return reports


def _resume_command(out: Path, seed: int, target: str | None, extra: Sequence[str]) -> str:
    """What goes on with a stopped demo up to its table and pictures; `gift-peft train` would end before them."""
    words = ["gift-peft", "demo", "--out", str(out), "--seed", str(seed)]
    words += ["--target", target, *extra] if target else extra
    if not any(word.replace("_", "-").startswith("--resume-from-checkpoint") for word in extra):
        words += ["--resume_from_checkpoint", "latest"]
    return shlex.join(words)


def _holds_demo(out: Path) -> bool:
    """Whether the run in a folder is a demo's: of the base and the groups beside it."""
    if not holds_run(out) or not (out / "config.yaml").is_file():
        return False
    arguments = read_yaml(out / "config.yaml")
    names = [Path(str(arguments.get(key))).name for key in ("model_name_or_path", "dataset_name")]
    return names == ["base", "gift-i"]


def _copy_embedded(name: str, destination: Path, earlier: bool) -> None:
    """A folder of the package; that of an `earlier` demo is replaced as a whole where it differs.

    Proxies stay: they are checked against what they were made for.
    """
    with as_file(files("gift_peft.demo") / name) as source:
        if not source.is_dir():
            raise FileNotFoundError(f"the installed package lacks gift_peft/demo/{name}; install it again")
        contents = strangers(source)
        if filecmp.cmpfiles(source, destination, contents, shallow=False)[0] == contents:
            return
        with whole_folder(destination, [*contents, "proxies/*"] if earlier else ()) as place:
            shutil.copytree(source, place, dirs_exist_ok=True)
            if (destination / "proxies").is_dir():
                os.replace(destination / "proxies", place / "proxies")
