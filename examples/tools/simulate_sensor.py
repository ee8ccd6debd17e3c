"""Depth of a simulated sensor for a dataset with true depth, as `gift-peft evaluate --sensor-depth` reads it.

python examples/tools/simulate_sensor.py demo/gift-i sensor
gift-peft evaluate --base demo/base --adapter demo/adapter --dataset demo/gift-i --sensor-depth sensor
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from gift_peft.dataset.gift_i import load_gift_i

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from helpers.simulated_sensor import simulate_sensor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset")
    parser.add_argument("out", type=Path)
    parser.add_argument("--split", default="validation")
    parser.add_argument("--first", action="store_true", help="the first observation of each group alone")
    args = parser.parse_args()
    count = 0
    for row in load_gift_i(args.dataset, args.split):
        folder = args.out / row["group_id"]
        folder.mkdir(parents=True, exist_ok=True)
        pictures = list(zip(row["image_names"], row["depths"], row["masks"], strict=True))
        for name, depth, mask in pictures[: 1 if args.first else None]:
            sensor = simulate_sensor(np.asarray(depth), np.asarray(mask) > 0, seed=count)
            Image.fromarray(sensor).save(folder / f"{Path(name).stem}.png")
            count += 1
    print(f"{count} files in {args.out}")


if __name__ == "__main__":
    main()
