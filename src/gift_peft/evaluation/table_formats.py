"""A table once, written four ways: terminal, Markdown, LaTeX (booktabs) and CSV.

Cells know what they are (a number, a change, an estimate with its interval), so that improvements are marked in every
form and the CSV keeps all digits.
"""

import csv
import io
import math
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field

WIDTH = 80
GREEN, RED, BOLD, RESET = "\x1b[32m", "\x1b[31m", "\x1b[1m", "\x1b[0m"
# Headings are written once, in Unicode: what a terminal and LaTeX make of them.
PLAIN = {" ↓": "", " ↑": "", "δ1": "delta1", "λ": "lambda_", "×": "x"}
LATEX = {
    "\\": r"\textbackslash{}",
    **{char: f"\\{char}" for char in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "↓": r"$\downarrow$",
    "↑": r"$\uparrow$",
    **{f"δ{factor}": rf"$\delta_{{{factor}}}$" for factor in ("1.05", "1.10", "1.15", "1.20")},
    "δ1": r"$\delta_1$",
    "λc": r"$\lambda_c$",
    "λd": r"$\lambda_d$",
    "×": r"$\times$",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
}


@dataclass(frozen=True)
class Cell:
    """One entry.

    Args:
        text (`str`): what is shown.
        values (`tuple[float, ...]`): the numbers behind it at full precision, for the CSV; an estimate has three.
        good (`bool`, *optional*): an improvement or the best of its column (True: marked), a change for the worse
            (False: red in a terminal), or neither (None).
    """

    text: str
    values: tuple[float, ...] = ()
    good: bool | None = None


@dataclass
class Table:
    """A table with its footnotes.

    Args:
        title (`str`): above it.
        labels (`list[str]`): headings of the leading text columns.
        columns (`list[str]`): headings of the others.
        rows (`list`): each labels and then cells; None is a rule.
        spans (`list[tuple[str, int]]`): headings over that many columns each, or none.
        notes (`list[str]`): below it.
    """

    title: str
    labels: list[str]
    columns: list[str]
    rows: list[list[str | Cell] | None]
    spans: list[tuple[str, int]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def body(self) -> list[list]:
        """The rows without rules."""
        return [row for row in self.rows if row is not None]

    def headings(self) -> list[str]:
        """The columns' headings with those that span them in front."""
        over = [title for title, count in self.spans for _ in range(count)] or [""] * len(self.columns)
        return [f"{title} {column}".strip() for title, column in zip(over, self.columns, strict=True)]


def number(value: float | None) -> str:
    """Five significant digits without an exponent, `-` for what is missing."""
    if value is None or math.isnan(value):
        return "-"
    if math.isinf(value):
        return "inf" if value > 0 else "-inf"
    digits = 0 if value == 0 else math.floor(math.log10(abs(value)))
    return f"{value:.{min(max(4 - digits, 0), 6)}f}"


def value_cell(value: float | None, good: bool | None = None) -> Cell:
    """A number."""
    return Cell(number(value), () if value is None or math.isnan(value) else (value,), good)


def change_cell(percent: float, better: bool) -> Cell:
    """A relative change with its sign."""
    if not math.isfinite(percent):
        return Cell("-")
    text = f"{percent:+.2f} %" if 0 < abs(percent) < 0.05 else f"{percent:+.1f} %"
    return Cell(text, (percent,), True if better else None if percent == 0 else False)


def estimate_cell(cell: Cell, interval: tuple[float, float]) -> Cell:
    """A number or change with its interval behind it; without the interval where that is not known."""
    if not cell.values or not all(map(math.isfinite, interval)):
        return cell
    if cell.text.endswith("%"):
        ends = "{:+.1f}, {:+.1f}".format(*interval)
    else:
        ends = ", ".join(map(number, interval))
    return Cell(f"{cell.text} [{ends}]", (*cell.values, *interval), cell.good)


# ---- terminal ----


def to_text(table: Table, color: bool = False) -> str:
    """Aligned plain text; improvements carry a `*` (and green if `color`). Spanned columns stand below one another."""
    parts = [_paint(_replace(table.title, PLAIN), BOLD, color)] if table.title else []
    start = len(table.labels)
    for title, count in table.spans or [("", len(table.columns))]:
        end = start + count
        columns = table.columns[start - len(table.labels) : end - len(table.labels)]
        rows = [row and [*row[: len(table.labels)], *row[start:end]] for row in table.rows]
        heading = [title or table.labels[0], *table.labels[1:]]
        parts.append("\n".join(_text_block(heading, columns, rows, color)))
        start = end
    notes = [line for note in table.notes for line in textwrap.wrap(_replace(note, PLAIN), WIDTH)]
    return "\n\n".join(parts) + "\n" + ("\n" + "\n".join(notes) + "\n" if notes else "")


def _text_block(labels: Sequence[str], columns: Sequence[str], rows: list, color: bool) -> list[str]:
    head = [*labels, *columns]
    lines = [[Cell(_replace(text, PLAIN)) for text in head]]
    lines += [[] if row is None else [_as_cell(item) for item in row] for row in rows]
    widths = [max(len(line[index].text) for line in lines if line) for index in range(len(head))]
    written = []
    for line in lines:
        text = ""
        for index, cell in enumerate(line):
            if index < len(labels):
                text += f"{_replace(cell.text, PLAIN):{widths[index]}}  "
                continue
            shown = _paint(
                cell.text, GREEN if cell.good else RED, color and cell.good is not None and bool(cell.values)
            )
            text += " " * max(widths[index] - len(cell.text), 0) + shown + ("*  " if cell.good else "   ")
        written.append(text.rstrip())
    return written


def _paint(text: str, code: str, color: bool) -> str:
    return f"{code}{text}{RESET}" if color else text


# ---- Markdown, LaTeX, CSV ----


def to_markdown(table: Table) -> str:
    """A pipe table; improvements are bold."""
    lines = [f"**{table.title}**", ""] if table.title else []
    lines.append("| " + " | ".join([*table.labels, *table.headings()]) + " |")
    lines.append("|" + "---|" * len(table.labels) + "---:|" * len(table.columns))
    for row in table.body():
        cells = [_as_cell(item) for item in row]
        texts = [cell.text.replace("|", r"\|") for cell in cells]
        texts = [f"**{text}**" if cell.good else text for text, cell in zip(texts, cells, strict=True)]
        lines.append("| " + " | ".join(texts) + " |")
    return (
        "\n".join(lines) + "\n" + ("\n" + "\n".join(f"{note}  " for note in table.notes) + "\n" if table.notes else "")
    )


def to_latex(table: Table) -> str:
    """A `table*` environment for the packages booktabs and graphicx, no wider than the text.

    Improvements are bold, the notes are in the caption.
    """
    layout = "l" * len(table.labels) + "r" * len(table.columns)
    lines = [r"\begin{table*}[t]", r"  \centering", r"  \small"]
    fitted = r"\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{"
    lines += [rf"  {fitted}\begin{{tabular}}{{{layout}}}", r"    \toprule"]
    if table.spans:
        first, over, rules = len(table.labels) + 1, [], []
        for title, count in table.spans:
            over.append(rf"\multicolumn{{{count}}}{{c}}{{{_latex(title)}}}")
            rules.append(rf"\cmidrule(lr){{{first}-{first + count - 1}}}")
            first += count
        lines += [f"    {'& ' * len(table.labels)}{' & '.join(over)} \\\\", f"    {''.join(rules)}"]
    lines += ["    " + " & ".join(map(_latex, [*table.labels, *table.columns])) + r" \\", r"    \midrule"]
    for row in table.rows:
        if row is None:
            lines.append(r"    \midrule")
            continue
        cells = [_as_cell(item) for item in row]
        texts = [rf"\textbf{{{_latex(cell.text)}}}" if cell.good else _latex(cell.text) for cell in cells]
        lines.append("    " + " & ".join(texts) + r" \\")
    caption = " ".join([f"{table.title}.", *table.notes]) if table.title else " ".join(table.notes)
    lines += [r"    \bottomrule", r"  \end{tabular}}", rf"  \caption{{{_latex(caption)}}}", r"\end{table*}"]
    return "\n".join(lines) + "\n"


def to_csv(table: Table) -> str:
    """RFC 4180 at full precision; an estimate takes three columns, its interval's ends behind it."""
    rows = [[_as_cell(item) for item in row] for row in table.body()]
    count = len(table.labels)
    parts = [max([len(row[count + i].values) for row in rows] or [1]) for i in range(len(table.columns))]
    header = list(table.labels)
    for heading, size in zip(table.headings(), parts, strict=True):
        heading = _replace(heading, PLAIN)
        header += [heading, f"{heading} low", f"{heading} high"] if size == 3 else [heading]
    output = io.StringIO()
    writer = csv.writer(output)
    writer.writerow(header)
    for row in rows:
        line = [cell.text for cell in row[:count]]
        for cell, size in zip(row[count:], parts, strict=True):
            size = max(size, 1)
            shown = [repr(float(value)) for value in cell.values] or ([] if cell.text == "-" else [cell.text])
            line += (shown + [""] * size)[:size]
        writer.writerow(line)
    return output.getvalue()


def _as_cell(item: str | Cell) -> Cell:
    return item if isinstance(item, Cell) else Cell(item)


def _replace(text: str, table: dict[str, str]) -> str:
    return re.sub("|".join(map(re.escape, table)), lambda match: table[match.group()], text)


def _latex(text: str) -> str:
    return _replace(text, LATEX)
