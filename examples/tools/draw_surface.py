"""The drawing of docs/surface-targets.md: what the base says along one line of pixels through a pane, and where it is.

    python examples/tools/draw_surface.py            # the embedded base and groups; extra `plots`

Takes the validation group of `KIND` on which the surface target improves most on the group's median: it shows the
idea, not how often it works (that is the tables' business). Writes `model_cards/images/surface_targets.png`.
"""

from importlib.resources import files
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image

from gift_peft import DepthModel, load_gift_i
from gift_peft.dataset.rows import parsed
from gift_peft.rules import GroupPictures
from gift_peft.surface_targets import paint_fills, surface_target

KIND, SIZE, FILLS = "pane", (112, 140), 6
SEEN, PAINTED, MIDDLE, SURFACE, TRUE = "#7c8794", "#d9a441", "#1d6fb8", "#c2410c", "#111111"
OUT = Path(__file__).parents[2] / "model_cards" / "images" / "surface_targets.png"


def main() -> None:
    demo = files("gift_peft.demo")
    model = DepthModel.from_pretrained(Path(str(demo / "base")), size=SIZE)
    groups = parsed(load_gift_i(Path(str(demo / "gift-i")), "validation"))
    found = [predict(groups[i], model) for i in range(len(groups)) if groups[i].group_id.startswith(KIND)]
    group, base, fills, target = max(found, key=lambda one: gain(one[0], one[1], one[3]))
    mask = group.masks[0]
    row = int(np.median(np.nonzero(mask)[0]))
    shown = int(np.argmin(base[:, mask].mean(1)))  # the photo in which the base sees farthest
    truth = [true_inverse(group, base, index) for index in range(len(base))]

    figure = plt.figure(figsize=(10.4, 3.9), dpi=120)
    photo = figure.add_axes((0.015, 0.49, 0.26, 0.40))
    photo.imshow(group.images[shown])
    photo.contour(mask, levels=[0.5], colors="white", linewidths=1)
    painted = figure.add_axes((0.015, 0.03, 0.26, 0.40))
    fill = next(paint_fills(np.asarray(group.images[shown]), mask, 1))
    painted.imshow(fill)
    for axes, title in ((photo, "a photo, its mask, one line of pixels"), (painted, "one of its six fills")):
        axes.axhline(row, color=SURFACE, linewidth=1, linestyle=":")
        axes.set_title(title, fontsize=9, pad=3)
        axes.set_axis_off()
    curves = figure.add_axes((0.335, 0.13, 0.64, 0.76))
    columns = np.arange(mask.shape[1])
    inside = np.where(mask[row], 1.0, np.nan)
    for index, own in enumerate(base):
        curves.plot(columns, own[row], color=SEEN, linewidth=1.2, label="the base, each photo" if not index else None)
    for index, own in enumerate(fills.reshape(-1, *SIZE)):
        curves.plot(columns, own[row] * inside, color=PAINTED, linewidth=0.6, label="each fill" if not index else None)
    curves.plot(columns, np.median(base, 0)[row] * inside, color=MIDDLE, linewidth=2.4, label="median: Eq. 3")
    curves.plot(columns, target[shown][row] * inside, color=SURFACE, linewidth=2.4, label="surface target")
    curves.plot(columns, truth[shown][row], color=TRUE, linewidth=1.2, linestyle="--", label="true surface")
    edges = np.flatnonzero(np.diff(mask[row].astype(int)))
    curves.axvspan(edges[0], edges[-1], color="#00000010", linewidth=0)
    curves.set_xlim(max(0, edges[0] - 22), min(mask.shape[1] - 1, edges[-1] + 22))
    curves.set_xlabel("pixel along the line (shaded: the target)", fontsize=9)
    curves.set_ylabel("inverse depth: up is near", fontsize=9)
    curves.legend(fontsize=8, loc="best", frameon=False)
    curves.spines[["top", "right"]].set_visible(False)
    curves.tick_params(labelsize=8)
    figure.savefig(OUT, facecolor="white")
    palette = {"method": Image.Quantize.MAXCOVERAGE, "kmeans": 3, "dither": Image.Dither.NONE}
    Image.open(OUT).convert("RGB").quantize(128, **palette).save(OUT, optimize=True)
    print(group.group_id, OUT)


def predict(group: GroupPictures, model: DepthModel) -> tuple[GroupPictures, np.ndarray, np.ndarray, np.ndarray]:
    """The group, predictions (N,H,W) of its photos and (N,F,H,W) of their fills, and the surface target."""
    base = model.predict(model.inputs(group.images)).numpy()
    fills = [
        model.predict(
            torch.cat([model.inputs([Image.fromarray(f)]) for f in paint_fills(np.asarray(image), mask, FILLS)])
        )
        for image, mask in zip(group.images, group.masks, strict=True)
    ]
    fills = torch.stack(fills).numpy()
    return group, base, fills, surface_target(base, np.stack(group.masks), fills=fills).depth


def true_inverse(group: GroupPictures, base: np.ndarray, index: int) -> np.ndarray:
    """True inverse depth of an observation in the base's units, fitted outside the target."""
    inverse, other = 1 / group.depths[index].astype(float), ~group.masks[index]
    slope, offset = np.polyfit(inverse[other], base[index][other], 1)
    return slope * inverse + offset


def gain(group: GroupPictures, base: np.ndarray, target: np.ndarray) -> float:
    """How much nearer the surface target is to the truth than the group's median, inside the masks."""
    median, total = np.median(base, 0), 0.0
    for index, mask in enumerate(group.masks):
        truth = true_inverse(group, base, index)
        total += np.mean(np.abs(median - truth)[mask]) - np.mean(np.abs(target[index] - truth)[mask])
    return total / len(base)


if __name__ == "__main__":
    main()
