"""The README's drawing of the idea, from a group of the demo: photos, the base's depths, their disagreement, the loss.

    python examples/tools/draw_idea.py demo            # a folder that `gift-peft demo` left

Takes the validation group of `KIND` with most disagreement and writes `model_cards/images/idea.png` (extra `plots`).
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import FancyArrowPatch
from PIL import Image

from gift_peft import DepthModel, load_gift_i

KIND = "pane"
PHOTOS = 3
INK, PULL, HOLD = "#222222", "#c2410c", "#1d6fb8"
OUT = Path(__file__).parents[2] / "model_cards" / "images" / "idea.png"


def main(demo: Path) -> None:
    model = DepthModel.from_pretrained(demo / "base", demo / "adapter")  # which knows the size of the training
    rows = [row for row in load_gift_i(demo / "gift-i", "validation") if row["group_id"].startswith(KIND)]
    photos, masks, depths = max((read(row, model) for row in rows), key=lambda group: disagreement(*group[1:])[1])
    picture, _ = disagreement(masks, depths)

    figure = plt.figure(figsize=(10.4, 5.0), dpi=120)
    low, high = np.percentile(depths, (2, 98))
    for index in range(PHOTOS):
        bottom = 0.60 - 0.295 * index
        show(figure, (0.01, bottom, 0.16, 0.27), photos[index], masks[index])
        show(figure, (0.235, bottom, 0.16, 0.27), depths[index], masks[index], cmap="Spectral_r", vmin=low, vmax=high)
        arrow(figure, (0.175, bottom + 0.135), (0.23, bottom + 0.135))
    show(figure, (0.47, 0.455, 0.16, 0.27), picture, masks[0], cmap="inferno")
    arrow(figure, (0.40, 0.72), (0.465, 0.63))
    arrow(figure, (0.40, 0.51), (0.465, 0.57))
    arrow(figure, (0.40, 0.32), (0.465, 0.48))
    arrow(figure, (0.635, 0.59), (0.69, 0.59))
    arrow(figure, (0.40, 0.145), (0.69, 0.145))
    head = {"fontsize": 11, "fontweight": "bold", "color": INK, "ha": "center", "va": "center"}
    figure.text(0.09, 0.94, "a group: one pane,\nthree backgrounds", **head)
    figure.text(0.315, 0.94, "the base model's depth\nof each photo", **head)
    figure.text(0.55, 0.80, "their disagreement\ninside the mask", **head)
    note(figure, 0.63, PULL, "inside: pull together", "The pane did not move, so\nthe depths must agree there.")
    note(figure, 0.185, HOLD, "outside: hold", "Everywhere else, stay with what\nthe frozen base model said.")
    figure.text(0.84, 0.375, "+", color=INK, fontsize=20, ha="center", va="center")
    figure.text(0.70, 0.94, "the loss, which trains\nan adapter of the base", **{**head, "ha": "left"})
    figure.savefig(OUT, facecolor="white")
    palette = {"method": Image.Quantize.MAXCOVERAGE, "kmeans": 3, "dither": Image.Dither.NONE}
    Image.open(OUT).convert("RGB").quantize(256, **palette).save(OUT, optimize=True)
    print(OUT)


def read(row: dict, model: DepthModel) -> tuple[list, list, np.ndarray]:
    """Photos, (H, W) bool masks and (PHOTOS, H, W) depths of the observations that differ most from each other."""
    depths = np.stack([model.depth_at(image, base=True) for image in row["images"]])
    masks = [np.asarray(mask) > 0 for mask in row["masks"]]
    inside = np.logical_and.reduce(masks)
    order = np.argsort([depth[inside].mean() for depth in depths])
    chosen = order[np.linspace(0, len(order) - 1, PHOTOS).round().astype(int)]
    return [row["images"][i] for i in chosen], [masks[i] for i in chosen], depths[chosen]


def disagreement(masks: list, depths: np.ndarray) -> tuple[np.ndarray, float]:
    """Mean absolute difference over the pairs, as a picture (NaN outside the masks), and its mean: Eq. 3."""
    pairs = [np.abs(a - b) for i, a in enumerate(depths) for b in depths[i + 1 :]]
    picture = np.where(np.logical_and.reduce(masks), np.mean(pairs, axis=0), np.nan)
    return picture, float(np.nanmean(picture))


def show(figure, place: tuple, picture, mask, **colors) -> None:
    axes = figure.add_axes(place)
    axes.set_facecolor("#eeeeee")
    axes.imshow(picture, **colors)
    axes.contour(mask, [0.5], colors="white", linewidths=2.4)
    axes.contour(mask, [0.5], colors=INK, linewidths=0.9)
    axes.set_xticks([])
    axes.set_yticks([])


def arrow(figure, start: tuple, end: tuple) -> None:
    patch = FancyArrowPatch(start, end, transform=figure.transFigure, arrowstyle="-|>", mutation_scale=12, color=INK)
    figure.add_artist(patch)


def note(figure, bottom: float, color: str, title: str, text: str) -> None:
    figure.text(0.70, bottom, title, color=color, fontsize=12, fontweight="bold")
    figure.text(0.70, bottom - 0.11, text, color=INK, fontsize=10.5)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
