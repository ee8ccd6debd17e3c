"""VGGT's image processor and pipelines."""

import numpy as np
import pytest
import torch
from helpers.backbones import picture, tiny_vggt
from PIL import Image
from transformers import pipeline
from transformers.modeling_outputs import DepthEstimatorOutput

from gift_peft.models.pixels import to_pixel_values
from gift_peft.models.vggt import VggtForDepthEstimation, VggtImageProcessorPil


@pytest.fixture(scope="module")
def tiny():
    return tiny_vggt()


def test_processor_only_resizes_and_rescales():
    processor = VggtImageProcessorPil()
    pictures = [picture(60, 80), picture(90, 50, seed=1)]
    pixels = processor(pictures, return_tensors="pt")["pixel_values"]
    assert pixels.shape == (2, 3, 476, 644) and pixels.dtype == torch.float32
    resized = np.asarray(pictures[1].resize((644, 476), Image.Resampling.BICUBIC), dtype=np.float32)
    np.testing.assert_allclose(pixels[1], resized.transpose(2, 0, 1) / 255, atol=1e-6)
    assert torch.equal(pixels, to_pixel_values(pictures, processor, (476, 644)))


@pytest.mark.parametrize(
    ("original", "network"),
    [((60, 80), (392, 518)), ((80, 60), (518, 518)), ((37, 37), (518, 518)), ((10, 1000), (14, 518))],
)
def test_crop_rule(original, network):
    processor = VggtImageProcessorPil(size={"height": 518, "width": 518}, keep_aspect_ratio=True)
    image = picture(*original)
    pixels = processor(image, return_tensors="pt")["pixel_values"]
    assert pixels.shape == (1, 3, *network)
    height = max(round(original[0] * 518 / original[1] / 14) * 14, 14)
    resized = np.asarray(image.resize((518, height), Image.Resampling.BICUBIC), dtype=np.float32) / 255
    top = max(0, height - 518) // 2
    np.testing.assert_allclose(pixels[0], resized.transpose(2, 0, 1)[:, top : top + 518], atol=1e-6)
    output = DepthEstimatorOutput(predicted_depth=pixels[:, 0])
    if height > 518:
        with pytest.raises(ValueError, match="was cut"):
            processor.post_process_depth_estimation(output, [original])
    else:
        assert processor.post_process_depth_estimation(output, [original])[0]["predicted_depth"].shape == original


@pytest.mark.parametrize(("original", "content"), [((60, 80), (392, 518)), ((100, 60), (518, 308))])
def test_pad_rule_and_its_inverse(original, content):
    processor = VggtImageProcessorPil(size={"height": 518, "width": 518}, keep_aspect_ratio=True, do_pad=True)
    image = picture(*original)
    pixels = processor(image, return_tensors="pt")["pixel_values"]
    assert pixels.shape == (1, 3, 518, 518)
    top, left = (518 - content[0]) // 2, (518 - content[1]) // 2
    inside = torch.zeros(518, 518, dtype=torch.bool)
    inside[top : top + content[0], left : left + content[1]] = True
    assert (pixels[:, :, ~inside] == 1).all()
    depth = torch.where(inside, 2.0, -100.0)[None]
    (result,) = processor.post_process_depth_estimation(DepthEstimatorOutput(predicted_depth=depth), [original])
    torch.testing.assert_close(result["predicted_depth"], torch.full(original, 2.0))


def test_transparent_pixels_become_white():
    image = Image.new("RGBA", (28, 28), (255, 0, 0, 0))
    pixels = VggtImageProcessorPil(size={"height": 28, "width": 28})(image, return_tensors="pt")["pixel_values"]
    torch.testing.assert_close(pixels, torch.ones(1, 3, 28, 28))


def test_processor_errors():
    processor = VggtImageProcessorPil()
    with pytest.raises(ValueError, match="NaN"):
        processor(np.full((28, 28, 3), np.nan, dtype=np.float32), do_resize=False)
    with pytest.raises(ValueError, match="do_rescale=False"):
        processor(np.full((28, 28, 3), 0.5, dtype=np.float32))
    pixels = processor(np.full((28, 28, 3), 0.5, dtype=np.float32), do_rescale=False, do_resize=False)["pixel_values"]
    assert (pixels[0] == 0.5).all()
    with pytest.raises(ValueError, match="normalises inside"):
        processor(picture(28, 28), do_normalize=True, image_mean=[0.5] * 3, image_std=[0.5] * 3)
    with pytest.raises(ValueError, match=r"different sizes \(322x644, 476x644\)"):
        processor([picture(40, 80), picture(60, 80)], keep_aspect_ratio=True, return_tensors="pt")
    with pytest.raises(ValueError, match="2 target sizes for 1"):
        processor.post_process_depth_estimation(
            DepthEstimatorOutput(predicted_depth=torch.ones(1, 2, 2)), [(2, 2)] * 2
        )
    with pytest.raises(ValueError, match=r"\(B, h, w\)"):
        processor.post_process_depth_estimation(DepthEstimatorOutput(predicted_depth=torch.ones(1, 2, 2, 2)))


def test_pipeline(tiny):
    processor = VggtImageProcessorPil(size={"height": 28, "width": 42})
    estimate = pipeline("depth-estimation", model=tiny, image_processor=processor)
    pictures = [picture(40, 50), picture(33, 70)]
    results = estimate(pictures, batch_size=2)
    assert [tuple(result["predicted_depth"].shape) for result in results] == [(40, 50), (33, 70)]
    assert results[0]["depth"].size == (50, 40)
    single = estimate(pictures[1])
    torch.testing.assert_close(single["predicted_depth"], results[1]["predicted_depth"], rtol=1e-4, atol=0)


def test_auto_classes_know_a_saved_folder(tmp_path, tiny):
    tiny.save_pretrained(tmp_path)
    VggtImageProcessorPil(size={"height": 28, "width": 42}, keep_aspect_ratio=True).save_pretrained(tmp_path)
    estimate = pipeline("depth-estimation", model=str(tmp_path))
    assert type(estimate.model) is VggtForDepthEstimation
    assert type(estimate.image_processor) is VggtImageProcessorPil
    assert estimate.image_processor.keep_aspect_ratio
    assert estimate(picture(40, 60))["predicted_depth"].shape == (40, 60)
