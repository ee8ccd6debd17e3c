"""Metric3D V2's image processor: sizes, padding, focal lengths."""

import numpy as np
import pytest
import torch
from helpers.backbones import picture
from PIL import Image
from transformers.modeling_outputs import DepthEstimatorOutput

from gift_peft.models.metric3d import Metric3DImageProcessorPil
from gift_peft.models.pixels import to_pixel_values


def close(actual, expected, tolerance):
    assert actual.shape == expected.shape
    assert (actual - expected).abs().max() <= tolerance


def test_processor_stretches_to_the_papers_size():
    processor = Metric3DImageProcessorPil()
    pixels = processor([picture(), picture(90, 50)], return_tensors="pt").pixel_values
    assert pixels.shape == (2, 3, 476, 644) and pixels.dtype == torch.float32
    expected = np.asarray(picture().resize((644, 476), Image.Resampling.BICUBIC), np.float32)
    expected = (expected - [123.675, 116.28, 103.53]) / [58.395, 57.12, 57.375]
    close(pixels[0], torch.from_numpy(expected).permute(2, 0, 1).float(), 1e-5)
    assert torch.equal(pixels[:1], to_pixel_values([picture()], processor, (476, 644)))


def test_processor_keeps_the_aspect_on_request(tmp_path):
    processor = Metric3DImageProcessorPil(keep_aspect_ratio=True, size={"height": 616, "width": 1064})
    processor.save_pretrained(tmp_path)
    processor = Metric3DImageProcessorPil.from_pretrained(tmp_path)
    wide = picture(100, 400)  # scaled by 2.66 to 266x1064, 175 rows above and below
    pixels = processor(wide, return_tensors="pt").pixel_values[0]
    assert pixels.shape == (3, 616, 1064)
    border = torch.cat([pixels[:, :175], pixels[:, 441:]], dim=1)
    assert border.abs().max() < 0.01  # the mean colour, rounded to 8 bits
    assert pixels[:, 175:441].abs().mean() > 0.3
    plain = torch.from_numpy(np.array(wide)).permute(2, 0, 1)[None].float()
    plain = torch.nn.functional.interpolate(plain, size=(266, 1064), mode="bilinear").round()
    mean, std = (torch.tensor(value).view(3, 1, 1) for value in (processor.image_mean, processor.image_std))
    close(pixels[:, 175:441], (plain[0] - mean) / std, 1e-5)
    # Depth that grows downwards over the canvas: without the padding it starts where the picture does.
    depth = torch.arange(616.0)[:, None].expand(616, 1064)[None]
    result = processor.post_process_depth_estimation(DepthEstimatorOutput(predicted_depth=depth), [(266, 1064)])
    assert torch.equal(result[0]["predicted_depth"][:, 0], torch.arange(175.0, 441.0))


def test_focal_lengths_make_depth_metric():
    processor = Metric3DImageProcessorPil()
    output = DepthEstimatorOutput(predicted_depth=torch.full((2, 476, 644), 10.0))
    sizes = [(480, 640), (240, 1288)]
    canonical = processor.post_process_depth_estimation(output, sizes)
    assert [tuple(item["predicted_depth"].shape) for item in canonical] == sizes
    assert all((item["predicted_depth"] == 10).all() for item in canonical)
    metric = processor.post_process_depth_estimation(output, sizes, focal_lengths=[518.86, (1000.0, 500.0)])
    close(metric[0]["predicted_depth"], torch.full(sizes[0], 10 * 518.86 * 644 / 640 / 1000), 1e-4)
    close(metric[1]["predicted_depth"], torch.full(sizes[1], 10 * (500 + 500 * 476 / 240) / 2 / 1000), 1e-4)
    kept = Metric3DImageProcessorPil(keep_aspect_ratio=True)
    metric = kept.post_process_depth_estimation(output, sizes, focal_lengths=[518.86, 1000])
    close(metric[0]["predicted_depth"], torch.full(sizes[0], 10 * 518.86 * 476 / 480 / 1000), 1e-4)
    close(metric[1]["predicted_depth"], torch.full(sizes[1], 5.0), 1e-4)
    unresized = processor.post_process_depth_estimation(output)
    assert torch.equal(unresized[0]["predicted_depth"], output.predicted_depth[0])


def test_processor_errors():
    processor = Metric3DImageProcessorPil()
    output = DepthEstimatorOutput(predicted_depth=torch.ones(1, 28, 28))
    bad = np.full((3, 30, 40), 7.0, np.float32)
    bad[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        processor(bad, return_tensors="pt")
    with pytest.raises(ValueError, match="multiply by 255"):
        processor(torch.rand(3, 30, 40), return_tensors="pt")
    with pytest.raises(ValueError, match="different sizes"):
        Metric3DImageProcessorPil(do_resize=False)([picture(), picture(30, 30)], return_tensors="pt")
    for sizes, focal, message in (
        ([(1, 1)] * 2, None, "2 target sizes for 1"),
        (None, [500], "need target_sizes"),
        ([(30, 40)], [0], "positive"),
        ([(30, 40)], [float("nan")], "positive"),
        ([(30, 40)], [None], "positive"),
        ([(30, 40)], [1, 2], "2 focal lengths for 1"),
        ([(30, 40)], 500.0, "focal lengths: a list, one per picture"),
        (torch.tensor(30), None, "target sizes: a list, one per picture"),
        ([(0, 40)], None, "a target size is"),
        ([(30, 40, 3)], None, "a target size is"),
    ):
        with pytest.raises(ValueError, match=message):
            processor.post_process_depth_estimation(output, sizes, focal)
