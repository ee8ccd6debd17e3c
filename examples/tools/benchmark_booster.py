"""How long `gift-peft evaluate --booster` takes on stored predictions, and how much memory, on a synthetic tree.

    python examples/tools/benchmark_booster.py  # 38 scenes, 228 images
    python examples/tools/benchmark_booster.py --scenes 1 --images 6 --size 3008x4112  # full size

The tree has the official set's layout and numbers and no picture of it. It is written to a temporary folder unless
--folder names one, which is then kept and used again.
"""

import argparse
import multiprocessing
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from gift_peft import evaluate_booster
from gift_peft.evaluation.tables import text_table
from gift_peft.models.pixels import parse_size
from gift_peft.training.profiling import peak_memory

CALIBRATION = """<?xml version="1.0"?>
<opencv_storage>
<proj_matL type_id="opencv-matrix"><rows>3</rows><cols>4</cols><dt>d</dt><data>
{focal} 0. 0. 0. 0. {focal} 0. 0. 0. 0. 1. 0.</data></proj_matL>
<baselineLR>80.</baselineLR>
</opencv_storage>
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=38)
    parser.add_argument("--images", type=int, default=228, help="of all scenes together")
    parser.add_argument("--size", default="752x1028", help="HxW of ground truth and predictions")
    parser.add_argument("--resize", type=float, default=1.0)
    parser.add_argument("--protocol", default="gift")
    parser.add_argument("--folder", help="where the tree is, or goes")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(args.folder or temporary)
        if not (folder / "balanced").exists():
            # In a process of its own, so that its memory is not counted.
            options = (folder, args.scenes, args.images, parse_size(args.size))
            writer = multiprocessing.get_context("spawn").Process(target=write_tree, args=options)
            writer.start()
            writer.join()
        before = peak_memory(torch.device("cpu")) / 2**20
        start, cpu = time.perf_counter(), time.process_time()
        report = evaluate_booster(
            folder,
            predictions=folder / "predictions",
            kind="inverse_depth",
            protocol=args.protocol,
            resize=args.resize,
            official=False,
        )
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    print(text_table(report))
    print(
        f"{report.counts['images']} images of {args.size} in {seconds:.1f} s ({cpu:.1f} s of processor time); peak "
        f"memory {peak_memory(torch.device('cpu')) / 2**20:.0f} MiB, of which {before:.0f} MiB before the first image"
    )


def write_tree(folder: Path, scenes: int, images: int, size: tuple[int, int]) -> None:
    """Smooth scenes with every material class and, as stored predictions, their disparity with noise."""
    rows, columns = np.mgrid[: size[0], : size[1]].astype(np.float32) / size[0]
    focal = 0.9 * size[1]
    for number in range(scenes):
        rng = np.random.default_rng(number)
        depth = 1200 + 500 * np.sin(5 * columns + number) + 300 * np.cos(7 * rows)
        scene = folder / "balanced" / f"Scene{number}"
        (scene / "camera_00").mkdir(parents=True)
        disparity = (focal * 80 / depth).astype(np.float32)
        np.save(scene / "disp_00.npy", np.where(rng.random(size) < 0.08, np.float32(0), disparity))
        classes = (4 * columns + 4 * rows + number).astype(np.uint8) % 4
        Image.fromarray(classes).save(scene / "mask_cat.png")
        Image.fromarray(np.full(size, 255, np.uint8)).save(scene / "mask_00.png")
        (scene / "calib_00-02.xml").write_text(CALIBRATION.format(focal=focal))
        place = folder / "predictions" / scene.name / "camera_00"
        place.mkdir(parents=True)
        for index in range(images // scenes + (number < images % scenes)):
            (scene / "camera_00" / f"im{index}.png").touch()  # the evaluation of stored predictions opens no picture
            noise = rng.standard_normal(size, dtype=np.float32)
            np.save(place / f"im{index}.npy", 0.02 * disparity * (1 + 0.05 * noise) + 0.1 * (classes >= 2))


if __name__ == "__main__":
    main()
