"""Using a GIFT adapter: a pipeline, switch off, fade, merge.

    python examples/inference.py --base demo/base --adapter demo/adapter --image photo.jpg

The pipeline needs transformers and peft alone; for VGGT and Metric3D V2, import gift_peft before it.
"""

import argparse

import numpy as np
from transformers import pipeline

from gift_peft import DepthModel, set_adapter_scale


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--base", required=True, help="hub id or folder of the base model")
    parser.add_argument("--adapter", required=True, help="hub id or folder of the adapter")
    parser.add_argument("--image", required=True, help="a picture")
    args = parser.parse_args()

    # The adapter names its base, and its folder brings the image processor with the size it was trained at.
    estimate = pipeline("depth-estimation", model=args.adapter, image_processor=args.adapter)
    show("pipeline", estimate(args.image)["predicted_depth"].numpy())

    # The same as float32 numpy, with the base beside it.
    model = DepthModel.from_pretrained(args.base, args.adapter)
    adapted = model.depth_at(args.image)
    show("adapted", adapted)
    show("adapter off", model.depth_at(args.image, base=True))

    # Fading: 0 is the base, 1 the adapter. `model.network` is an ordinary PeftModel.
    set_adapter_scale(model.network, 0.5)
    show("scale 0.5", model.depth_at(args.image))
    set_adapter_scale(model.network, 1.0)

    # Merging: a model without PEFT, to save and use like any other.
    merged = DepthModel(model.network.merge_and_unload(), model.processor, model.size)
    difference = np.abs(merged.depth_at(args.image) - adapted).max()
    print(f"merged: differs from the adapter by at most {difference:.1e}")


def show(name: str, depth: np.ndarray) -> None:
    print(f"{name}: {depth.shape}, {depth.min():.4f} to {depth.max():.4f}, mean {depth.mean():.4f}")


if __name__ == "__main__":
    main()
