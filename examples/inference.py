"""Using a GIFT adapter with peft and transformers: load, switch off, fade, merge, pipeline.

    python examples/inference.py --base demo/base --adapter demo/adapter --image photo.jpg

Only fading needs gift_peft (and models of ours, gift_vggt and gift_metric3d, need it imported before loading).
"""

import argparse

import torch
from peft import PeftModel
from PIL import Image
from transformers import AutoImageProcessor, AutoModelForDepthEstimation, pipeline

from gift_peft import set_adapter_scale


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--base", required=True, help="hub id or folder of the base model")
    parser.add_argument("--adapter", required=True, help="hub id or folder of the adapter")
    parser.add_argument("--image", required=True, help="a picture")
    args = parser.parse_args()
    image = Image.open(args.image).convert("RGB")

    # The plain way. The adapter's folder brings the image processor with the size it was trained at.
    processor = AutoImageProcessor.from_pretrained(args.adapter, backend="pil")
    base = AutoModelForDepthEstimation.from_pretrained(args.base)
    model = PeftModel.from_pretrained(base, args.adapter).eval()
    pixel_values = processor(images=image, return_tensors="pt")["pixel_values"]

    def predict(network) -> torch.Tensor:
        with torch.no_grad():
            return network(pixel_values=pixel_values).predicted_depth[0]

    adapted = predict(model)
    show("adapted", adapted)

    # Switching off: exactly the base model.
    with model.disable_adapter():
        plain = predict(model)
    show("adapter off", plain)

    # Fading: 0 is the base, 1 the adapter.
    set_adapter_scale(model, 0.5)
    show("scale 0.5", predict(model))
    set_adapter_scale(model, 1.0)

    # Merging: a model without PEFT, to save and use like any other.
    merged = model.merge_and_unload()
    difference = (predict(merged) - adapted).abs().max()
    print(f"merged: differs from the adapter by at most {difference:.1e}")

    # The pipeline takes the merged model, or the adapter's name alone.
    estimate = pipeline("depth-estimation", model=args.adapter, image_processor=processor)
    depth = estimate(image)["predicted_depth"]
    show(f"pipeline, at the picture's size {tuple(depth.shape)}", depth)


def show(name: str, depth: torch.Tensor) -> None:
    print(f"{name}: {depth.min():.4f} to {depth.max():.4f}, mean {depth.mean():.4f}")


if __name__ == "__main__":
    main()
