"""A clip and a mask of every group: what is reflected or seen through changes, camera and target stand still.

    python examples/tools/group_clips.py demo/gift-i clips
    gift-peft predict --video clips/solid_007.mp4 --sensor-mask clips/solid_007.png --base demo/base \\
        --adapter demo/adapter --out flicker

Ten frames a second: each observation for one, then faded into the next over two more, the last into the first.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from gift_peft.dataset.gift_i import load_gift_i

FADE = (0, 1 / 3, 2 / 3)


def write_clip(path: Path, pictures: list[np.ndarray]) -> None:
    """(H,W,3) uint8 RGB, of even sides."""
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (width, height))
    for first, second in zip(pictures, pictures[1:] + pictures[:1], strict=True):
        for share in FADE:
            frame = np.rint((1 - share) * first + share * second).astype(np.uint8)
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset")
    parser.add_argument("out", type=Path)
    parser.add_argument("--split", default="validation")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for row in load_gift_i(args.dataset, args.split):
        width, height = (side // 2 * 2 for side in row["images"][0].size)
        pictures = [np.asarray(picture.convert("RGB"))[:height, :width] for picture in row["images"]]
        write_clip(args.out / f"{row['group_id']}.mp4", pictures)
        mask = (np.asarray(row["masks"][0])[:height, :width] > 0).astype(np.uint8) * 255
        Image.fromarray(mask).save(args.out / f"{row['group_id']}.png")
        print(args.out / f"{row['group_id']}.mp4")


if __name__ == "__main__":
    main()
