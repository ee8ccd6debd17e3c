"""Random trees in the layouts of LayeredDepth and MD-3k."""

import json

import numpy as np
from PIL import Image


def write_layered(root, photos="images", indices=(0, 3, 11), size=(24, 32), seed=0):
    """A tree in the benchmark's layout; returns {subset: {index: tuples}}."""
    rng = np.random.default_rng(seed)
    tuples = {}
    (root / photos).mkdir(parents=True, exist_ok=True)
    for index in indices:
        Image.fromarray(rng.integers(0, 255, (*size, 3), dtype=np.uint8)).save(root / photos / f"{index}.png")
    for subset, count in (("pairs", 2), ("triplets", 3), ("quadruplets", 4)):
        folder = root / f"{subset}_layer1_val"
        folder.mkdir()
        tuples[subset] = {}
        for index in indices[: 3 if subset == "pairs" else 2]:  # not every photo has every kind
            own = rng.integers(-1, 34, (20, count, 2))
            tuples[subset][index] = own
            lines = [json.dumps([[int(x), int(y), 1] for x, y in points]) for points in own]
            (folder / f"{index}.jsonl").write_text("\n".join(lines) + "\n")
    return tuples


def write_md3k(root, size=(24, 32), seed=0, count=40):
    """annotations.json and photos of random pairs; returns the annotations."""
    rng = np.random.default_rng(seed)
    (root / "images").mkdir(parents=True)
    content = {}
    for index in range(3):
        name = f"images/{index}.png"
        Image.fromarray(rng.integers(0, 255, (*size, 3), dtype=np.uint8)).save(root / name)
        content[name] = []
        for _ in range(count):
            first, second = rng.choice(["near", "far"], 2).tolist()
            points = [[int(rng.integers(0, size[1])), int(rng.integers(0, size[0]))] for _ in range(2)]
            content[name].append(
                {
                    "point1": points[0],
                    "point2": points[1],
                    "foreground_label": first,
                    "background_label": second,
                    "subset": "same" if first == second else "reverse",
                }
            )
    (root / "annotations.json").write_text(json.dumps(content))
    return content
