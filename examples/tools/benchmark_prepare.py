"""How fast `gift-peft prepare` is: frames a second per core, and what a second process brings.

    python examples/tools/benchmark_prepare.py [--groups 8] [--frames 5]

Makes groups of moved 1280x720 frames in a temporary folder and prepares them with one process, then with two.
Processor time is printed beside wall time: on a machine that does other things as well, only the first says much.
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from gift_peft.prepare.prepare import prepare_gift_i


def write_group(folder: Path, seed: int, frames: int, size=(720, 1280)) -> None:
    """One picture of shapes and texture, seen by a camera that shifts a little, with a target that changes."""
    rng = np.random.default_rng(seed)
    height, width = size
    picture = cv2.resize(rng.uniform(60, 190, (5, 8, 3)).astype(np.float32), (width, height))
    for _ in range(150):
        centre, axes = rng.integers(0, [width, height]).tolist(), rng.integers(8, 90, 2).tolist()
        cv2.ellipse(picture, centre, axes, 0, 0, 360, rng.uniform(10, 245, 3).tolist(), -1, cv2.LINE_AA)
    picture += cv2.resize(rng.normal(0, 8, (height // 3, width // 3, 3)).astype(np.float32), (width, height))
    mask = np.zeros(size, np.uint8)
    cv2.ellipse(mask, (width // 2, height // 2), (width // 8, height // 5), 0, 0, 360, 255, -1)
    (folder / "masks").mkdir(parents=True)
    for index in range(frames):
        angle = rng.uniform(-1, 1) * (index < frames - 1)
        matrix = cv2.getRotationMatrix2D((width / 2, height / 2), angle, 1)
        matrix[:, 2] += rng.uniform(-8, 8, 2) * (index < frames - 1)
        frame = cv2.warpAffine(picture, matrix, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        there = cv2.warpAffine(mask, matrix, (width, height), flags=cv2.INTER_NEAREST)
        frame[there > 0] = np.roll(picture, 37 * (index + 1), axis=1)[there > 0]
        frame = np.clip(frame + rng.normal(0, 2, frame.shape), 0, 255).astype(np.uint8)
        Image.fromarray(frame).save(folder / f"{index}.jpg", quality=95)
        Image.fromarray(there).save(folder / "masks" / f"{index}.png")


def processor_seconds() -> float:
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--groups", type=int, default=8)
    parser.add_argument("--frames", type=int, default=5)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        for seed in range(args.groups):
            write_group(Path(place) / "raw" / f"group_{seed}", seed, args.frames)
        walls = []
        for processes in (1, 2):
            wall, used = time.perf_counter(), processor_seconds()
            report = prepare_gift_i(Path(place) / "raw", Path(place) / f"out_{processes}", num_proc=processes)
            wall, used = time.perf_counter() - wall, processor_seconds() - used
            walls.append(wall)
            frames, found = args.groups * args.frames, report["statistics"]["train"]
            print(
                f"{processes} process(es): {frames} frames, {found['warped_frames']} warped, {wall:.1f} s, "
                f"{frames / wall:.2f} frames/s; {used:.1f} s of processor time, {frames / used:.2f} frames/s a core"
            )
        print(f"2 processes are {walls[0] / walls[1]:.2f} times as fast as one")


if __name__ == "__main__":
    main()
