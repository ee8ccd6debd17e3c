"""`report.html` of a prepared dataset: one file without scripts or links, made from `report.json` (`entries.py`).

Statistics at the top, then a row per group: every frame with its mask's outline, what was done to it and why, and its
figures with their meaning. A picture that is clicked is enlarged, as far as its share of the file's size allows. The
flicker box of a group lets its frames alternate with the one they were registered to, which shows a camera that moved
at once; a warped frame is shown before and after, with its differences from that frame.
"""

import html
import json
import math
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from tqdm import tqdm

from gift_peft.files import write_whole
from gift_peft.images import jpeg_uri, open_image
from gift_peft.prepare.quality import plain_number

WIDTH = 240  # of the thumbnails as they are shown, in pixels
LARGEST = 960  # of a picture in the file, which is shown when it is clicked
PIXELS = 60e6  # of all pictures in the file, about 12 MB; the more there are, the smaller they get
AMPLIFY = 4  # of the differences

STYLE = """
:root { color-scheme: light dark; --line: #8885; --good: #2a8a4a; --warn: #b26a00; --bad: #c2332e; --mask: #00e0ff }
body { font: 15px/1.45 system-ui, sans-serif; margin: 1.5rem auto; max-width: 1500px; padding: 0 1rem }
h1, h2 { line-height: 1.2; margin: 0 } h2 { font-size: 1.1rem; overflow-wrap: anywhere }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .8rem 0 }
th, td { border-bottom: 1px solid var(--line); padding: .25rem .7rem; text-align: right }
td { white-space: nowrap } .scroll { overflow-x: auto }
th:first-child, td:first-child { text-align: left }
.index { display: flex; flex-wrap: wrap; gap: .3rem; margin: .8rem 0; padding: 0; list-style: none }
.tag { border: 1px solid; border-radius: .6rem; font-size: .8rem; padding: 0 .5rem; text-decoration: none }
.kept, .identity { color: var(--good) } .warped, .warning { color: var(--warn) }
.rejected, .dropped { color: var(--bad) }
section { border-top: 1px solid var(--line); margin-top: 1.2rem; padding-top: .8rem }
section p, section ul { margin: .3rem 0 } .facts { opacity: .75 }
.strip { display: flex; gap: .8rem; overflow-x: auto; padding: .5rem 0 }
figure { flex: none; margin: 0 } figcaption { font-size: .82rem; max-width: max(240px, 100%); overflow-wrap: anywhere }
.shots { display: flex; gap: .3rem } .narrow figcaption { width: 240px } .wide figcaption { width: 960px }
.shot { background: var(--target, none) 0 0 / 100% 100%; height: max-content; position: relative; width: 240px }
.shot img { display: block; height: auto; width: 100% }
.shot svg { height: 100%; inset: 0; position: absolute; width: 100% }
.shot path { fill: none; stroke: var(--mask); stroke-width: 1.5; vector-effect: non-scaling-stroke }
.shot .outside { stroke: var(--bad); stroke-dasharray: 4 3 } .shot .proposed { stroke: #ff3df0; stroke-dasharray: 5 2 }
.shot span { background: #000a; bottom: 0; color: #fff; font-size: .72rem; left: 0; padding: 0 .3rem }
.shot span { position: absolute }
.shot[tabindex] { cursor: zoom-in }
.shot:focus { cursor: default; inset: 0; margin: auto; outline: 100vmax solid #000c;
  position: fixed; width: min(94vw, 94vh * var(--ratio)); z-index: 1 }
.missing { align-items: center; border: 1px dashed; box-sizing: border-box; display: flex; height: 135px;
  justify-content: center; width: 240px }
details { margin: .4rem 0 } pre { white-space: pre-wrap; overflow-wrap: anywhere }
.flicker:checked ~ .strip .blink img { animation: flicker 1s steps(1) infinite }
@keyframes flicker { 50% { opacity: 0 } }
"""

# What the words in the report mean. Statuses: the word, and its meaning.
STATUSES = {
    "identity": ("not moved", "the camera stood still, so the photo is kept as it is"),
    "warped": ("moved into place", "the camera had moved; the photo is resampled to where it stood"),
    "dropped": ("dropped", "not in the dataset, for the reason below it"),
    "kept": ("registered to", "the photo that the others of its group are compared with and moved to"),
    "rejected": ("not checked", "the group was rejected before this photo was looked at"),
}
# Figures of quality: the heading, its unit or number format, and its meaning.
QUALITY = {
    "clipped_dark": ("nearly black", "%", "share of the pixels"),
    "clipped_bright": ("nearly white", "%", "share of the pixels"),
    "outside_change": (
        "change outside",
        "%",
        "share of the pixels outside the target whose surroundings look different",
    ),
    "outside_correlation": ("likeness outside", ".2f", "correlation outside the target; 1 is the same picture"),
    "sharpness": ("sharpness", ".2f", "1 is the middle of the group"),
    "target_change": (
        "change inside",
        ".1f",
        "grey levels (0 to 255) inside the target, against the most similar photo",
    ),
    "mask_area": ("target area", "%", "share of the image that is target"),
    "mask_border": ("target at the border", "%", "share of the image's border that is target"),
    "mask_iou": (
        "mask agreement",
        "%",
        "overlap (intersection over union) with the mask that most photos of the group have",
    ),
}
MEANINGS = {
    "inliers": "matches that one motion of the camera explains",
    "spread": "how far these lie apart, over the image's diagonal",
    "motion, moves": "in pixels of the photos",
    "expected error": "of the registration, at the target's corners",
    "difference": "mean grey difference (0 to 255) outside the target, before and after registration",
    **{heading: meaning for heading, _, meaning in QUALITY.values()},
}

FIGURES = {  # of a frame's registration: heading and number format
    "method": ("method", "s"),
    "matches": ("matches", "d"),
    "inliers": ("inliers", "d"),
    "inlier_ratio": ("inlier ratio", ".2f"),
    "spread": ("spread", ".2f"),
    "median_displacement": ("median motion (px)", ".2f"),
    "target_displacement": ("target moves (px)", ".2f"),
    "corner_displacement": ("corner moves (px)", ".1f"),
    "expected_error": ("expected error (px)", ".2f"),
    "contrast_threshold": ("SIFT contrast", ".3f"),
    "difference_before": ("difference before", ".2f"),
    "difference_after": ("after", ".2f"),
}


def write_html(out: Path, report: dict) -> Path:
    """Write `out/report.html`, whole or not at all, and return it.

    Args:
        out (`Path`): the prepared folder, whose pictures are embedded as thumbnails.
        report (`dict`): what `prepare_gift_i` writes as `report.json`. A picture that is not there or cannot be read
            becomes an empty frame.

    Raises:
        OSError: the file cannot be written.
    """
    out = Path(out)
    groups = report["groups"]
    frames = sum(len(group["frames"]) for group in groups)
    shots = sum(4 if frame["status"] == "warped" else 1 for group in groups for frame in group["frames"])
    width = round(min(LARGEST, max(WIDTH, math.sqrt(PIXELS / 0.75 / max(1, shots)))))
    with tqdm(total=frames, unit="frame", desc="report.html", disable=None, leave=False) as bar:
        sections = [_group(index, group, out, out / report["raw"], width, bar) for index, group in enumerate(groups)]
    title = f"{len(groups)} groups, {frames} frames"
    page = [
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Captures: ' + title + "</title>",
        '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">',
        f"<style>{STYLE}</style></head><body>\n<h1>Captures: {title}</h1>",
        _statistics(report["statistics"]),
        _index(groups),
        '<p class="facts">Outlines: <span style="color:var(--mask)">target mask</span>, '
        '<span style="color:#d33bc8">proposed mask</span>, '
        '<span style="color:var(--bad)">border of what a photo shows that was moved into place</span>. '
        "Click a picture to enlarge it, and beside it to go back.</p>",
        f'<p class="facts">{" · ".join(f"<b>{word}</b>: {meaning}" for word, meaning in STATUSES.values())}</p>',
        *sections,
        "<details><summary>Settings and versions</summary><pre>",
        _text(json.dumps({key: report.get(key) for key in ("settings", "versions")}, indent=1, ensure_ascii=False)),
        "</pre></details>\n</body></html>\n",
    ]
    write_whole(out / "report.html", "\n".join(page))
    return out / "report.html"


# ---- the top ----


def _statistics(statistics: dict) -> str:
    counts = ("groups", "rejected_groups", "images", "pairs", "references", "warped_frames", "dropped_frames")
    head = ["split", *(key.partition("_")[0] for key in counts), "images per group", "mask area"]
    rows = []
    for split, found in statistics.items():
        cells = [split, *(_number(found.get(key), "d") for key in counts)]
        cells.append(_range(found.get("group_size"), 1, ".3g"))
        rows.append([*cells, _range(found.get("mask_area"), 100, ".3g", " %")])
    return _table(head, rows)


def _range(found: dict | None, factor: float, form: str, unit: str = "") -> str:
    if not found:
        return "–"
    low, high, mean = (_number(factor * found[key], form) for key in ("min", "max", "mean"))
    return f"{low} – {high}{unit} (mean {mean}{unit})"


def _index(groups: list[dict]) -> str:
    items = [
        f'<li><a class="tag {_mood(group)}" href="#g{index}">{_text(group["group_id"])}</a></li>'
        for index, group in enumerate(groups)
    ]
    return f'<ul class="index">{"".join(items)}</ul>'


def _mood(group: dict) -> str:
    if group["status"] == "rejected":
        return "rejected"
    warned = group["warnings"] or any(frame["warnings"] or frame["reasons"] for frame in group["frames"])
    return "warning" if warned else "kept"


# ---- one group ----


def _group(index: int, group: dict, out: Path, raw: Path, width: int, bar: tqdm) -> str:
    frames = group["frames"]
    target = next((frame for frame in frames if frame["name"] == group["target_frame"]), None)
    target_image = None if target is None else _picture(target, out, raw, width)
    style = f' style="--target:url({jpeg_uri(target_image, quality=75)})"' if target_image is not None else ""
    proposal = group.get("proposal")
    size = group.get("size")
    facts = [group["split"], group.get("surface"), f"{size[0]}×{size[1]}" if size else None, group.get("notes")]
    facts += [f"{QUALITY[key][0]} {_measured(key, value)}" for key, value in (group.get("quality") or {}).items()]
    if proposal:
        facts.append(
            f"masks proposed with a score of {_number(proposal.get('score'), '.2f')} (0 to 1), "
            + ("accepted" if proposal.get("accepted") else "not accepted: not used")
        )
    parts = [
        f'<section id="g{index}"{style}>',
        f'<h2>{_text(group["group_id"])} <span class="tag {_mood(group)}">{_text(group["status"])}</span></h2>',
        f'<p class="facts">{" · ".join(_text(fact) for fact in facts if fact)}</p>',
        _remarks(group["reasons"], "rejected"),
        _remarks(group["warnings"], "warning"),
        f'<input type="checkbox" class="flicker" id="f{index}"><label for="f{index}"> flicker against '
        f"{_text(target['name'])}</label>"
        if target_image is not None
        else "",
        '<div class="strip">',
    ]
    for frame in frames:
        parts.append(_frame(frame, group, target_image, out, raw, width))
        bar.update()
    return "\n".join([*parts, "</div>", _figures(frames), "</section>"])


def _frame(frame: dict, group: dict, target: Image.Image | None, out: Path, raw: Path, width: int) -> str:
    image = _picture(frame, out, raw, width)
    is_target = frame["name"] == group["target_frame"]
    blink = "" if is_target or target is None else " blink"
    outlines = [
        _outline(frame.get("mask"), out, ""),
        _outline(frame.get("valid"), out, "outside"),
        _outline(_proposed(frame, group), out, "proposed"),
    ]
    wide = frame["status"] == "warped" and image is not None and target is not None
    if wide:
        before = _thumbnail(raw / frame["original"], width)
        shots = [_shot(before, "before", blink), _shot(image, "after", blink, outlines)]
        shots += [
            _shot(_difference(shown, target), f"{AMPLIFY} × difference {label}")
            for shown, label in ((before, "before"), (image, "after"))
        ]
    else:
        shots = [_shot(image, frame["role"] if frame["role"] != "observation" else "", blink, outlines)]
    status = mood = frame["status"]
    if status == "kept" and group["status"] != "kept":  # else it is the frame that the others are registered to
        status, mood = "rejected", ""
    word, meaning = STATUSES[status]
    moved = (frame.get("registration") or {}).get("median_displacement")
    tag = f'<span class="tag {mood}" title="{_text(meaning)}">{_text(word)}</span>'
    return (
        f'<figure class="{"wide" if wide else "narrow"}"><div class="shots">{"".join(shots)}</div>'
        f"<figcaption><b>{_text(frame['name'])}</b> {tag}"
        + (f" camera motion {_number(moved, '.2f')} px" if moved is not None else "")
        + _remarks(frame["reasons"], "dropped")
        + _remarks(frame["warnings"], "warning")
        + "</figcaption></figure>"
    )


def _figures(frames: list[dict]) -> str:
    """Every figure of every frame; with --paper-exact also what the paper's rule says of its registration."""
    if not any(frame.get("registration") or frame.get("quality") for frame in frames):
        return ""
    measured = list(dict.fromkeys(key for frame in frames for key in frame.get("quality") or {}))
    exact = any((frame.get("registration") or {}).get("paper_exact") for frame in frames)
    rows = []
    for frame in frames:
        found, quality = frame.get("registration") or {}, frame.get("quality") or {}
        cells = [_number(found.get(key), form) for key, (_, form) in FIGURES.items()]
        cells += [_verdict(found.get("paper_exact"))] if exact else []
        rows.append([frame["name"], *cells, *(_measured(key, quality.get(key)) for key in measured)])
    head = ["frame", *(heading for heading, _ in FIGURES.values()), *(["the paper's rule alone"] if exact else [])]
    head += [QUALITY[key][0] for key in measured]
    meanings = " · ".join(f"<b>{_text(word)}</b>: {_text(meaning)}" for word, meaning in MEANINGS.items())
    return f'<details><summary>Figures</summary>{_table(head, rows)}<p class="facts">{meanings}</p></details>'


def _verdict(paper: dict | None) -> str:
    if not paper:
        return "–"
    moved = paper.get("corner_displacement")
    corner = "" if moved is None else f", corner {_number(moved, '.1f')} px"
    return ("accepts" if paper["accepted"] else "refuses") + corner


# ---- pictures ----


def _thumbnail(path: Path, width: int) -> Image.Image | None:
    """RGB, `width` wide or as wide as the photo, at least WIDTH; None if the file cannot be read."""
    try:
        image = open_image(path)
        width = max(WIDTH, min(width, image.width))
        size = width, max(1, round(width * image.height / image.width))
        return image.convert("RGB").resize(size, Image.Resampling.BOX, reducing_gap=2)
    except (OSError, ValueError):
        return None


def _picture(frame: dict, out: Path, raw: Path, width: int) -> Image.Image | None:
    return _thumbnail(out / frame["prepared"] if frame.get("prepared") else raw / frame["original"], width)


def _difference(image: Image.Image | None, target: Image.Image) -> Image.Image | None:
    if image is None or image.size != target.size:
        return None
    grey = [np.asarray(picture.convert("L"), np.int16) for picture in (image, target)]
    return Image.fromarray(np.clip(AMPLIFY * np.abs(grey[0] - grey[1]), 0, 255).astype(np.uint8)).convert("RGB")


def _shot(image: Image.Image | None, label: str, blink: str = "", outlines: Iterable[str] = ()) -> str:
    if image is None:
        return '<div class="missing">no picture</div>'
    paths = "".join(outlines)
    overlay = f'<svg viewBox="0 0 1 1" preserveAspectRatio="none">{paths}</svg>' if paths else ""
    caption = f"<span>{_text(label)}</span>" if label else ""
    size = f'width="{image.width}" height="{image.height}"'
    picture = f'<img src="{jpeg_uri(image, quality=75)}" {size} alt="{_text(label)}">'
    ratio = f"--ratio:{image.width / image.height:.4g}"
    return f'<div class="shot{blink}" tabindex="0" style="{ratio}">{picture}{overlay}{caption}</div>'


def _proposed(frame: dict, group: dict) -> str | None:
    """The proposed mask of a frame; one that is in use is already drawn as the mask."""
    proposal = group.get("proposal") or {}
    masks = proposal.get("masks") or []
    if proposal.get("accepted") or frame["role"] != "observation" or not masks:
        return None
    stem = Path(frame["name"]).stem
    return next((mask for mask in masks if Path(mask).stem == stem), masks[0])


def _outline(path: str | None, out: Path, kind: str) -> str:
    """An SVG path round a mask's regions, in fractions of the image; nothing for a mask that cannot be read."""
    if path is None:
        return ""
    try:
        mask = np.asarray(open_image(out / path)) > 0
    except (OSError, ValueError):
        return ""
    if mask.all():  # its border would be the picture's
        return ""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    tolerance = max(mask.shape) / WIDTH / 2
    size = np.array(mask.shape[::-1])
    drawn = []
    for contour in contours:
        points = (cv2.approxPolyDP(contour, tolerance, True)[:, 0] + 0.5) / size
        drawn.append("M" + " ".join(f"{x:.4g},{y:.4g}" for x, y in points) + "Z")
    return f'<path class="{kind}" d="{"".join(drawn)}"/>' if drawn else ""


# ---- words ----


def _remarks(remarks: list[dict], kind: str) -> str:
    items = "".join(f'<li class="{kind}">{_text(remark["text"])}</li>' for remark in remarks)
    return f"<ul>{items}</ul>" if items else ""


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["".join(f"<th>{_text(cell)}</th>" for cell in head)]
    lines += ["".join(f"<td>{_text(cell)}</td>" for cell in row) for row in rows]
    return f'<div class="scroll"><table>{"".join(f"<tr>{line}</tr>" for line in lines)}</table></div>'


def _number(value, form: str = ".3g") -> str:
    """A figure in this form, but never with an exponent."""
    if value is None:
        return "–"
    if not isinstance(value, int | float) or form == "s":
        return str(value)
    return plain_number(value) if form == ".3g" else format(round(value) if form == "d" else value, form)


def _measured(key: str, value: float | None) -> str:
    """A figure of quality in its unit."""
    unit = QUALITY[key][1]
    if value is None or unit.startswith("."):
        return _number(value, unit)
    return f"{_number(100 * value)} %" if unit == "%" else f"{_number(value, '.1f')} {unit}"


def _text(value) -> str:
    return html.escape(str(value))
