"""`gift-peft report RUN...`: the paper's tables and figures of one's own runs, and the adapter's model card.

Reads what training and evaluation left behind. Pictures need the base, the adapter and the data again, curves need
matplotlib: if one of them is missing, the report says so and has the rest.
"""

import filecmp
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from gift_peft.adapters.folder import ADAPTER_WEIGHTS
from gift_peft.evaluation.ordering_tables import TITLES, ordering_tables
from gift_peft.evaluation.results import Report
from gift_peft.evaluation.table_formats import Table, to_csv, to_latex, to_markdown, to_text
from gift_peft.evaluation.tables import comparison_table, group_table, protocol_note, uncertainty_table
from gift_peft.files import check_inputs_stay, check_own_file, reason, write_whole
from gift_peft.images import list_images
from gift_peft.reports.ablation import ablation_table, is_ablation
from gift_peft.reports.chosen import chosen_panels, notable_observations
from gift_peft.reports.compare import write_compare
from gift_peft.reports.curves import draw_dynamics, draw_retention
from gift_peft.reports.dial_curve import draw_dial
from gift_peft.reports.figures import Panel, before_after, error_maps
from gift_peft.reports.model_card import MARK, model_card
from gift_peft.reports.saved_run import SavedRun, folder_names, read_run, run_names
from gift_peft.reports.zero_shot import checkpoint_folders, draw_zero_shot

HEAD = "# GIFT: "  # a report.md of ours begins so
WRITTEN = ("report.md", "tables/*", "*.png", "*.pdf", "compare*.html", "model_card.md")
HEADINGS = {
    "gift-i-proxy": "GIFT-I, against the treated reference",
    "gift-i-depth": "GIFT-I, against true depth",
    "booster": "Booster",
}


@dataclass
class Output:
    """What a report writes, in the order of report.md."""

    folder: Path
    color: bool
    sections: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def table(self, name: str, table: Table, show: bool = False) -> None:
        """A table as Markdown, LaTeX, CSV and text; `show` prints it as well."""
        folder = self.folder / "tables"
        folder.mkdir(exist_ok=True)
        for suffix, write in (("txt", to_text), ("md", to_markdown), ("tex", to_latex), ("csv", to_csv)):
            write_whole(folder / f"{name}.{suffix}", write(table))
        self.sections.append(to_markdown(table))
        if show:
            print(to_text(table, self.color))

    def figure(self, name: str, title: str, draw: Callable[..., object]) -> None:
        """A figure as PNG and as PDF."""
        for suffix in (".png", ".pdf"):
            draw(path=self.folder / f"{name}{suffix}")
        self.sections.append(f"![{title}]({name}.png)\n")

    def remark(self, text: str) -> None:
        """Note what is missing in the report, and why."""
        if text not in self.remarks:
            self.remarks.append(text)


def run_report(
    runs: Sequence[str | Path],
    out: str | Path | None = None,
    *,
    card: str | Path | bool = False,
    zero_shot: Sequence[str | Path] = (),
    steps: Sequence[int] = (),
    panels: int = 3,
    device: str | None = None,
    color: bool = False,
) -> Path:
    """Write tables, figures, compare.html and report.md of `runs`; returns their folder.

    A run without a saved evaluation is evaluated first (into `RUN/evaluation`).

    Args:
        runs: folders of runs or evaluations; with `card` alone also the YAML file of a planned run.
        out (*optional*): default `RUN/report` of the only run, `report` here for several.
        card: also write the model card of the (only) run: True for `out`/model_card.md, or a file.
        zero_shot: pictures for the figure of base and checkpoints, or folders of them.
        steps: the checkpoints in that figure; default those of `checkpoint_at_steps`, else all.
        panels: rows of the before/after figure; 0 draws no pictures.
        device (*optional*): for the models.
        color: of the tables printed.

    Raises:
        FileNotFoundError: a folder that is neither run nor evaluation; a picture or checkpoint that is not there.
        ValueError: a damaged file; a card of several runs; an output that would replace a picture or what no report
            wrote.
    """
    if not runs or panels < 0:
        raise ValueError(f"panels: must not be negative, got {panels}" if runs else "report needs a run")
    saved = [read_run(path) for path in runs]
    if card and len(saved) > 1:
        raise ValueError("--model-card is of one run: name one")
    if card and not saved[0].arguments:
        raise ValueError(f"{saved[0].path}: no config.yaml, so nothing says what was trained; name the run's folder")
    planned = [run for run in saved if run.path.is_file()]
    if planned and not card:
        raise ValueError(f"{planned[0].path}: not a run yet; --model-card FILE writes the card of what it will be")
    if card and (planned or card is not True):
        path = Path("model_card.md" if card is True else card)
        check_inputs_stay([path], [run.path for run in planned])
        check_own_file(path, MARK, "--model-card")
        if planned:
            return _write_card(saved[0], path)
    if zero_shot:  # fail early on a missing picture or checkpoint
        list_images(zero_shot)
        for run in saved:
            checkpoint_folders(run, steps)
    folder = Path(out) if out else saved[0].path / "report" if len(saved) == 1 else Path("report")
    names = run_names(saved)
    _claim(folder, names)
    if zero_shot:
        drawn = [folder / f"zero-shot-{own}{suffix}" for own in folder_names(saved) for suffix in (".png", ".pdf")]
        check_inputs_stay(drawn, list_images(zero_shot))
    output = Output(folder, color)
    for run in saved:
        _evaluate_if_missing(run, output, device)
    _tables(saved, names, output)
    _orderings(saved, names, output)
    _curves(saved, names, output)
    for run, name, own in zip(saved, names, folder_names(saved), strict=True):
        if panels:
            _pictures(run, name, output, panels, device, f"-{own}" if len(saved) > 1 else "")
        if zero_shot:
            _zero_shot(run, f"zero-shot-{own}", zero_shot, steps, output, device)
    if card:
        path = _write_card(saved[0], folder / "model_card.md" if card is True else Path(card))
        output.sections.append(f"Model card: [{path.name}]({path.name if path.parent == folder else path})\n")
    _write_markdown(names, output)
    print(f"Report: {folder}/report.md")
    for remark in output.remarks:
        print(f"  not in it: {remark}")
    return folder


def _claim(folder: Path, names: Sequence[str]) -> None:
    """Make the report's folder; ValueError if it holds files in the way of the report that no report wrote."""
    page = folder / "report.md"
    if page.is_file() and page.read_bytes().startswith(HEAD.encode()):
        return
    if there := sorted({path.relative_to(folder).parts[0] for name in WRITTEN for path in folder.glob(name)}):
        raise ValueError(f"{folder} has {', '.join(there[:3])}, which no report wrote: it is kept; name another --out")
    write_whole(page, f"{HEAD}{', '.join(dict.fromkeys(names))}\n\nNot finished: run `gift-peft report` again.\n")


def _write_card(run: SavedRun, path: Path) -> Path:
    reports = [report for report in run.evaluations.values() if _is_of_adapter(run, report)]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, model_card(run.arguments, run.record, reports))
    print(f"Model card: {path}")
    return path


def _is_of_adapter(run: SavedRun, report: Report) -> bool:
    """Whether an evaluation is of the run's adapter: of these weights, at scale 1."""
    if not report.adapted or report.about.get("adapter_scale") not in (None, 1):
        return False
    evaluated = Path(report.about.get("adapter") or "") / ADAPTER_WEIGHTS
    if run.adapter is None or not evaluated.is_file():
        return True  # nothing to compare: the run was moved, or is an evaluation alone
    return filecmp.cmp(evaluated, run.adapter / ADAPTER_WEIGHTS, shallow=False)


def _evaluate_if_missing(run: SavedRun, output: Output, device: str | None) -> None:
    if run.evaluations or run.orderings or run.adapter is None:
        return
    from gift_peft.evaluation.verb import run_evaluation

    arguments = run.arguments
    try:
        report = run_evaluation(
            arguments["model_name_or_path"],
            arguments["dataset_name"],
            run.adapter,
            revision=arguments.get("model_revision"),
            out=run.path / "evaluation",
            device=device,
        )
    except (OSError, ValueError, KeyError) as error:
        output.remark(f"tables of {run.path}, which has no evaluation and could not be evaluated: {reason(error)}")
        return
    run.evaluations["evaluation"] = report


# ---- tables ----


def _tables(runs: Sequence[SavedRun], names: Sequence[str], output: Output) -> None:
    """One comparison per dataset and protocol, with intervals and groups of every report behind it."""
    together: dict[tuple, list[tuple[str, str, Report]]] = {}
    for run, name, own in zip(runs, names, folder_names(runs), strict=True):
        kinds = {place: (_dataset(one), one.unit, protocol_note(one)) for place, one in run.evaluations.items()}
        for place, report in run.evaluations.items():
            again = list(kinds.values()).count(kinds[place]) > 1  # evaluated twice this way: the folder tells which
            called = _scaled(f"{name} ({place})" if again else name, report)
            together.setdefault(kinds[place], []).append((called, own, report))
    used: dict[str, int] = {}
    for (dataset, *_), entries in together.items():
        used[dataset] = used.get(dataset, 0) + 1
        stem = dataset if used[dataset] == 1 else f"{dataset}-{used[dataset]}"
        output.sections.append(f"## {HEADINGS[dataset]}\n")
        output.table(stem, comparison_table([(name, report) for name, _, report in entries]), show=True)
        for number, (name, own, report) in enumerate(entries):
            if len(entries) > 1:
                output.sections.append(f"### {name}\n")
            again = sum(other == own for _, other, _ in entries[:number])  # a run evaluated twice this way
            full = f"{stem}-{own}" + (f"-{again + 1}" if again else "") if len(entries) > 1 else stem
            output.table(f"{full}-intervals", uncertainty_table(report))
            output.table(f"{full}-groups", group_table(report))
    if is_ablation(runs):
        output.sections.append("## Loss weights\n")
        output.table("loss-weights", ablation_table(runs), show=True)


def _dataset(report: Report) -> str:
    return "booster" if report.dataset == "booster" else f"gift-i-{report.reference}"


def _scaled(name: str, report: Report) -> str:
    scale = report.about.get("adapter_scale")
    return name if scale in (None, 1) else f"{name} (adapter scale {scale:g})"


def _orderings(runs: Sequence[SavedRun], names: Sequence[str], output: Output) -> None:
    """LayeredDepth and MD-3k of each run, with the layer dial's curve where it was turned."""
    for run, name, own in zip(runs, names, folder_names(runs), strict=True):
        for folder, report in run.orderings.items():
            stem = f"{folder}-{own}" if len(runs) > 1 else folder
            output.sections.append(f"## {TITLES[report.dataset]}: {name}\n")
            for table, suffix in zip(ordering_tables(report), ("", "-dial"), strict=False):
                output.table(f"{stem}{suffix}", table, show=True)
            if not report.dial:
                continue
            try:
                draw_dial(report, [output.folder / f"{stem}-dial{suffix}" for suffix in (".png", ".pdf")])
            except ImportError as error:
                output.remark(f"{stem}-dial.png: {reason(error)}")
                continue
            output.sections.append(f"![layer dial]({stem}-dial.png)\n")


# ---- curves ----


def _curves(runs: Sequence[SavedRun], names: Sequence[str], output: Output) -> None:
    histories = [(name, run.history) for run, name in zip(runs, names, strict=True) if len(run.history) > 1]
    if not histories:
        return
    for name, title, draw in (
        ("dynamics", "GCE and ToM error in training, relative to the base", draw_dynamics),
        ("retention", "Error outside the target in training, relative to the base", draw_retention),
    ):
        try:
            drawn = draw(histories, [output.folder / f"{name}.png", output.folder / f"{name}.pdf"])
        except (ImportError, ValueError) as error:
            output.remark(f"{name}.png: {reason(error)}")
            continue
        if drawn:
            output.sections.append(f"## {title}\n\n![{title}]({name}.png)\n")


# ---- pictures ----


def _pictures(run: SavedRun, name: str, output: Output, count: int, device: str | None, suffix: str) -> None:
    """Before and after, error maps and compare.html of a run: true depth before proxies, and Booster."""
    reports = {_dataset(r): r for r in run.evaluations.values() if r.adapted and r.base and r.about.get("adapter")}
    if "gift-i-depth" in reports:
        reports.pop("gift-i-proxy", None)
    for dataset, report in reports.items():
        stem = f"{'-booster' if dataset == 'booster' else ''}{suffix}"
        reference = {"gift-i-proxy": "proxy", "gift-i-depth": "true depth", "booster": "measured depth"}[dataset]
        notable = notable_observations(report, count)
        kept: dict[tuple[str, str], Panel] = {}
        title = f"{name}: before and after, {HEADINGS[dataset]}"
        try:
            stream = chosen_panels(run, report, notable, kept, device)
            write_compare(
                stream,
                output.folder / f"compare{stem}.html",
                title=title,
                notes=[protocol_note(report), "Per group the observation on which the base errs most, and extremes."],
                columns=("RGB", reference, "base", "GIFT"),
            )
        except (OSError, ValueError) as error:
            output.remark(f"pictures of {run.path}: {reason(error)}")
            continue
        rows = [kept[key] for key in notable]
        output.sections.append(f"## {title}\n\n[Sliders](compare{stem}.html)\n")
        columns = ("RGB", reference, "base", "GIFT")
        output.figure(f"before-after{stem}", title, partial(before_after, rows, columns=columns))
        output.figure(f"errors{stem}", f"{title}: errors", partial(error_maps, rows))


def _zero_shot(
    run: SavedRun, name: str, images: Sequence[str | Path], steps: Sequence[int], output: Output, device: str | None
) -> None:
    draw_zero_shot(run, images, steps, [output.folder / f"{name}.png", output.folder / f"{name}.pdf"], device)
    output.sections.append(f"## Pictures the training never saw\n\n![base and checkpoints]({name}.png)\n")


def _write_markdown(names: Sequence[str], output: Output) -> None:
    head = f"{HEAD}{', '.join(dict.fromkeys(names))}\n"
    missing = [f"Not in this report: {remark}\n" for remark in output.remarks]
    write_whole(output.folder / "report.md", "\n".join([head, *output.sections, *missing]))
