"""Mask proposals: where synthetic groups change, and the SAM 2 path with a tiny random model."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.prepare.proposals import Proposal, propose, refine

SIZE = (120, 160)  # height, width


def texture(rng, size=SIZE):
    coarse = rng.uniform(20, 210, (9, 12, 3))  # brighter, and exposure would clip it
    return cv2.resize(coarse, size[::-1], interpolation=cv2.INTER_LINEAR)


def scene(mask, count, seed=0, noise=2.0, gains=(0.85, 1.1), shadow=False):
    """`count` photos of one scene, each with other exposure and noise, and another texture inside `mask`."""
    rng = np.random.default_rng(seed)
    base = texture(rng, mask.shape)
    images = []
    for _ in range(count):
        image = np.where(mask[..., None], texture(rng, mask.shape), base)
        if shadow:
            y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
            distance = np.hypot(y - rng.uniform(0, mask.shape[0]), x - rng.uniform(0, mask.shape[1]))
            image *= 1 - 0.25 * np.exp(-((distance / 50) ** 2))[..., None]
        image = image * rng.uniform(*gains) + rng.normal(0, noise, image.shape)
        images.append(np.clip(image, 0, 255).astype(np.uint8))
    return images


def box(top, left, height, width, size=SIZE):
    mask = np.zeros(size, bool)
    mask[top : top + height, left : left + width] = True
    return mask


def iou(a, b):
    return (a & b).sum() / max((a | b).sum(), 1)


@given(
    st.integers(3, 7), st.integers(0, 70), st.integers(0, 80), st.integers(35, 50), st.integers(35, 80), st.integers(0)
)
# The textures are random, and one in some thousands changes too little for the score: the examples are fixed.
@settings(max_examples=25, deadline=None, derandomize=True)
def test_a_changing_box_is_proposed(count, top, left, height, width, seed):
    mask = box(top, left, height, width)
    proposal = propose(scene(mask, count, seed % 2**32))
    assert proposal.mask.shape == SIZE and proposal.mask.dtype == bool
    assert iou(proposal.mask, mask) > 0.6
    assert 0.5 < proposal.score <= 1 and proposal.refined is None
    assert proposal.score == pytest.approx(proposal.concentration * proposal.changed * proposal.edge)


@pytest.mark.parametrize("share", [0.5, 0.6, 0.7])
def test_a_target_that_fills_most_of_the_image(share):
    side = share**0.5
    mask = box(5, 8, int(SIZE[0] * side), int(SIZE[1] * side))
    assert iou(propose(scene(mask, 4)).mask, mask) > 0.75


def test_several_regions_and_large_images():
    mask = box(300, 200, 200, 150, (720, 1280)) | box(100, 800, 300, 200, (720, 1280))
    assert iou(propose(scene(mask, 3)).mask, mask) > 0.93


@pytest.mark.parametrize("images", [scene(box(0, 0, 0, 0), 4), scene(box(0, 0, 0, 0), 3, shadow=True)])
def test_noise_exposure_and_soft_light_score_low(images):
    assert propose(images).score < 0.5


def test_equal_images_propose_nothing():
    proposal = propose([np.full((30, 40, 3), 90, np.uint8)] * 3)
    assert not proposal.mask.any() and proposal.score == 0


def test_a_frame_with_a_passer_by_does_not_decide():
    mask, passer_by = box(30, 30, 50, 50), box(20, 110, 90, 30)
    images = scene(mask, 6)
    images[2] = np.where(passer_by[..., None], 10, images[2]).astype(np.uint8)
    assert not (propose(images).mask & passer_by).any()


@pytest.mark.parametrize("size", [(1, 1), (2, 700), (3, 5)])
def test_odd_sizes(size):
    rng = np.random.default_rng(0)
    proposal = propose([rng.integers(0, 255, (*size, 3), dtype=np.uint8) for _ in range(2)])
    assert proposal.mask.shape == size and 0 <= proposal.score <= 1


@pytest.mark.parametrize(
    ("images", "message"),
    [
        ([np.zeros((4, 4, 3), np.uint8)], "at least two"),
        ([np.zeros((4, 4, 3), np.uint8), np.zeros((4, 5, 3), np.uint8)], "one size"),
        ([np.zeros((4, 4), np.uint8)] * 2, "uint8 RGB"),
        ([np.zeros((4, 4, 3))] * 2, "uint8 RGB"),
    ],
)
def test_wrong_images_are_refused(images, message):
    with pytest.raises(ValueError, match=message):
        propose(images)


# ---- SAM 2 ----


@pytest.fixture(scope="module")
def sam2(tmp_path_factory):
    """A random SAM 2 of a few thousand weights at 128x128, as a transformers folder."""
    from transformers import (
        Sam2Config,
        Sam2HieraDetConfig,
        Sam2MaskDecoderConfig,
        Sam2Model,
        Sam2PromptEncoderConfig,
        Sam2VisionConfig,
    )

    backbone = Sam2HieraDetConfig(
        hidden_size=8,
        num_attention_heads=1,
        image_size=[128, 128],
        blocks_per_stage=[1, 1, 1, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 2, 4, 8],
        window_size_per_stage=[4, 2, 4, 2],
        global_attention_blocks=[],
        window_positional_embedding_background_size=[4, 4],
    )
    config = Sam2Config(
        vision_config=Sam2VisionConfig(
            backbone_config=backbone,
            backbone_channel_list=[64, 32, 16, 8],
            backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]],
            fpn_hidden_size=32,
        ),
        prompt_encoder_config=Sam2PromptEncoderConfig(hidden_size=32, image_size=128, patch_size=16),
        mask_decoder_config=Sam2MaskDecoderConfig(
            hidden_size=32, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=32
        ),
    )
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("sam2")
    Sam2Model(config).save_pretrained(folder)
    return folder


def test_refining_runs_sam2_and_keeps_what_it_does_not_find(sam2):
    mask = box(30, 30, 50, 50) | box(70, 110, 30, 30)
    image = scene(mask, 1)[0]
    refined = refine(Proposal(mask, 0.9), image, f"sam2:{sam2}")
    assert refined.refined == f"sam2:{sam2}" and refined.score == 0.9
    assert refined.mask.shape == SIZE and refined.mask.dtype == bool
    assert 0 <= refined.kept_regions <= 2
    assert {type(value) for value in vars(refined).values()} <= {np.ndarray, float, int, str}  # goes into a JSON
    if refined.kept_regions == 2:
        np.testing.assert_array_equal(refined.mask, mask)
    empty = refine(Proposal(np.zeros(SIZE, bool), 0.0), image, f"sam2:{sam2}")
    assert not empty.mask.any() and empty.kept_regions == 0


def test_sam2_gets_each_region_in_its_own_pixels_and_its_best_mask_is_taken(sam2, monkeypatch):
    """A stand-in for the network that draws the box it is given: prompts, scaling and choice are checked by it."""
    from transformers import Sam2Model
    from transformers.models.sam2.modeling_sam2 import Sam2ImageSegmentationOutput

    regions = [box(30, 30, 50, 50), box(70, 110, 30, 40)]
    seen = {}

    def draw(self, pixel_values, input_boxes, input_points, input_labels):
        seen.update(pixels=pixel_values, points=input_points, labels=input_labels)
        logits = torch.full((1, 2, 3, 128, 128), -4.0)
        for index, (x0, y0, x1, y1) in enumerate(input_boxes[0].round().int().tolist()):
            logits[0, index, 1, y0:y1, x0:x1] = 4.0
            logits[0, index, 2] = 4.0  # everything
        return Sam2ImageSegmentationOutput(pred_masks=logits)

    monkeypatch.setattr(Sam2Model, "forward", draw)
    refined = refine(Proposal(regions[0] | regions[1], 0.9), scene(regions[0], 1)[0], f"sam2:{sam2}")
    assert iou(refined.mask, regions[0] | regions[1]) > 0.93 and refined.kept_regions == 0
    assert seen["pixels"].shape == (1, 3, 128, 128) and (seen["labels"] == 1).all()
    for (x, y), region in zip(seen["points"][0, :, 0].tolist(), regions, strict=True):
        assert region[int(y * SIZE[0] / 128), int(x * SIZE[1] / 128)]


def test_sam2_that_finds_something_else_leaves_the_region(sam2, monkeypatch):
    from transformers import Sam2Model
    from transformers.models.sam2.modeling_sam2 import Sam2ImageSegmentationOutput

    everything = Sam2ImageSegmentationOutput(pred_masks=torch.ones(1, 1, 3, 32, 32))
    monkeypatch.setattr(Sam2Model, "forward", lambda self, **_: everything)
    mask = box(30, 30, 50, 50)
    refined = refine(Proposal(mask, 0.9), scene(mask, 1)[0], f"sam2:{sam2}")
    np.testing.assert_array_equal(refined.mask, mask)
    assert refined.kept_regions == 1


def test_refining_refuses(tmp_path):
    proposal, image = Proposal(box(3, 3, 9, 9), 0.9), np.zeros((*SIZE, 3), np.uint8)
    for method in ("sam", "sam2:", "grabcut:x"):
        with pytest.raises(ValueError, match="write sam2:<model id>"):
            refine(proposal, image, method)
    with pytest.raises(ValueError, match="the model cannot be loaded") as error:
        refine(proposal, image, f"sam2:{tmp_path}")
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="the proposal's size"):
        refine(proposal, image[:5], "sam2:x")


def test_the_measuring_example(tmp_path, monkeypatch, capsys):
    """On a raw tree whose masks are where its groups change; one of a single observation and a reference."""
    import runpy
    import sys
    from pathlib import Path

    from PIL import Image

    mask = box(40, 40, 50, 60)
    for split, count in (("train", 3), ("validation", 2)):
        folder = tmp_path / split / "scene"
        (folder / "masks").mkdir(parents=True)
        names = [f"{index}" for index in range(count)]
        names[-1] = "reference" if split == "validation" else names[-1]
        for name, image in zip(names, scene(mask, count), strict=True):
            Image.fromarray(image).save(folder / f"{name}.png")
            if name != "reference":
                Image.fromarray(mask).save(folder / "masks" / f"{name}.png")
    script = Path(__file__).parents[2] / "examples" / "tools" / "measure_proposals.py"
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path)])
    runpy.run_path(str(script), run_name="__main__")
    line, mean = capsys.readouterr().out.splitlines()
    assert line.startswith("scene") and mean.startswith("1 groups: mean IoU 0.")
    assert float(mean.split()[-1]) > 0.7
