"""The pictures and the card of the demo's report, as `model_cards/` shows them.

    gift-peft demo --out DEMO --checkpoint_at_steps 636,1272
    python examples/tools/embedded/report_pictures.py DEMO

Runs `gift-peft report` on the demo (needs the extra `plots`), reduces its figures to 920 pixels and a palette and,
where Chromium is installed, takes the first view of compare.html as well.
"""

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path

from PIL import Image

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.demo.side_by_side import KINDS
from gift_peft.reports.report import run_report

CARDS = Path(__file__).parents[3] / "model_cards"
IMAGES = CARDS / "images"
FIGURES = {"before-after": "panels", "errors": "errors", "dynamics": "dynamics", "retention": "retention"}
WIDTH = 920
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path, help="folder of a demo that ended")
    demo = parser.parse_args().demo
    rows = load_gift_i(demo / "gift-i", "validation")
    names = rows["group_id"][:]
    with tempfile.TemporaryDirectory() as place:
        pictures = [Path(place, f"{kind}.png") for kind in KINDS]
        for kind, picture in zip(KINDS, pictures, strict=True):
            first = min(name for name in names if name.startswith(kind))
            rows[names.index(first)]["images"][0].save(picture)
        folder = run_report([demo], card=CARDS / "demo_adapter.md", zero_shot=pictures)
    reduce(demo / "before_after.png", IMAGES / "demo_before_after.png")
    for name, target in FIGURES.items():
        reduce(folder / f"{name}.png", IMAGES / f"demo_{target}.png")
    reduce(folder / f"zero-shot-{demo.resolve().name}.png", IMAGES / "demo_zero_shot.png")
    if browser := next(filter(None, map(shutil.which, BROWSERS)), None):
        with tempfile.TemporaryDirectory() as temporary:
            shot = Path(temporary) / "compare.png"
            options = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync"]
            options += ["--disable-background-networking", "--disable-component-update", "--window-size=1200,800"]
            options += [f"--user-data-dir={temporary}/profile", f"--screenshot={shot}"]
            subprocess.run([browser, *options, (folder / "compare.html").resolve().as_uri()], check=True)
            reduce(shot, IMAGES / "demo_compare.png")


def reduce(source: Path, target: Path) -> None:
    """At most WIDTH wide, 256 colours: a fifth of the size, and the colour map's steps stay invisible."""
    image = Image.open(source).convert("RGB")
    if image.width > WIDTH:
        size = (WIDTH, round(image.height * WIDTH / image.width))
        image = image.resize(size, Image.Resampling.LANCZOS)
    palette = {"method": Image.Quantize.MAXCOVERAGE, "kmeans": 3, "dither": Image.Dither.NONE}  # keeps photos' colours
    image.quantize(256, **palette).save(target, optimize=True)
    print(f"{target}: {target.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
