"""Put the finished renders and the pre-trained base where the package ships them.

    python examples/tools/embedded/assemble.py --groups renders/groups --model renders/model/base

The groups become parquet shards, as `gift-peft export` writes them.
Training groups go without depth and without their treated reference: the demo must not be able to look at them.
`--complete` writes them with both, to measure how well the base knows the treated surfaces and what the groups teach.
"""

import argparse
import json
import shutil
import tempfile
from pathlib import Path

from gift_peft.dataset.export import export_parquet
from gift_peft.dataset.writer import write_gift_i

DEMO = Path(__file__).resolve().parents[3] / "src" / "gift_peft" / "demo"
DESCRIPTION = """Rendered rooms (Mitsuba 3) for trying GIFT without a camera: mirrors on walls and standing, glass
panes on feet, glass objects on tables. In two thirds or more of a group's observations the surface itself can be seen
(a sheet before the mirror, a card behind the pane, a filling), in the others what is reflected or transmitted. Made by
`examples/tools/embedded/render_groups.py`; validation groups carry exact depth."""


def read_groups(root: Path, split: str, complete: bool):
    """Group records for `write_gift_i`; incomplete ones lack depth and reference."""
    for folder in sorted((root / split).iterdir()):
        if not (folder / "group.json").exists():
            continue
        facts = json.loads((folder / "group.json").read_text())
        yield {
            "split": split,
            "group_id": folder.name,
            "surface": facts["surface"],
            "images": sorted(folder.glob("images/*.jpg")),
            "masks": sorted(folder.glob("masks/*.png")),
            "depths": sorted(folder.glob("depths/*.png")) if complete else [],
            "reference": folder / "reference.jpg" if complete else None,
        }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--groups", type=Path, default=Path("renders/groups"))
    parser.add_argument("--model", type=Path, default=Path("renders/model/base"))
    parser.add_argument("--out", type=Path, default=DEMO)
    parser.add_argument("--complete", action="store_true", help="keep depth and reference of the training groups too")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as loose:
        for split in ("train", "validation"):
            write_gift_i(
                read_groups(args.groups, split, args.complete or split == "validation"),
                loose,
                license="apache-2.0",
                pretty_name="mini GIFT-I",
                description=DESCRIPTION,
            )
        shutil.rmtree(args.out / "gift-i", ignore_errors=True)
        export_parquet(loose, args.out / "gift-i")
    shutil.copytree(args.model, args.out / "base", copy_function=shutil.copyfile, dirs_exist_ok=True)
    size = sum(path.stat().st_size for name in ("gift-i", "base") for path in (args.out / name).rglob("*.*"))
    print(f"{args.out}: {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
