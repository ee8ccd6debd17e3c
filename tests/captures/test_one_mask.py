"""Photos without an annotation: one mask holds for a group, an empty one is never filled, and nothing is silent."""

import io
import json
import logging

import datasets
import numpy as np
import pytest
from helpers.drawn_masks import CORNERS, SIZE, coco, labelme, percent, region, tasks
from PIL import Image

import gift_peft  # noqa: F401 - registers the builder
from gift_peft.captures.tree import list_groups, raw_example
from gift_peft.dataset.gift_i import load_gift_i

pytestmark = pytest.mark.usefixtures("fresh_cache")
BOX = np.zeros(SIZE[::-1], bool)
BOX[2:6, 3:9] = True
OTHER = np.roll(BOX, 1, axis=1)


@pytest.fixture
def group(tmp_path):
    """RAW/train/scene with three photos and no mask."""
    folder = tmp_path / "raw/train/scene"
    folder.mkdir(parents=True)
    for name in "123":
        pixels = np.random.default_rng(int(name)).integers(0, 255, (*SIZE[::-1], 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"{name}.png")
    return folder


def draw(group, name, mask=BOX):
    path = group / name
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(mask.astype(np.uint8) * 255).save(path)


def read(group, split="train", **choices):
    row = raw_example(group, split, group.parents[1], **choices)
    files = [mask if isinstance(mask, str) else io.BytesIO(mask["bytes"]) for mask in row["masks"]]
    return [np.asarray(Image.open(file)) > 0 for file in files]


def equal(masks, *expected):
    for mask, right in zip(masks, expected, strict=True):
        np.testing.assert_array_equal(mask, right)


def many(labeled, tool="coco"):
    """An export that lists all three photos, with a region for those named."""
    if tool == "label studio":
        return [
            tasks(*[region(points=percent(CORNERS))] * (name in labeled), image=f"/x/{name}.png")[0]
            | ({} if name in labeled else {"annotations": []})
            for name in "123"
        ]
    content = coco("1.png")
    content["images"] = [{"id": int(name), "file_name": f"{name}.png"} for name in "123"]
    box = {"category_id": 2, "bbox": [3, 2, 6, 4]}
    content["annotations"] = [{"image_id": int(name), **box} for name in labeled]
    return content


@pytest.mark.parametrize("tool", ["picture", "labelme", "coco", "label studio"])
@pytest.mark.parametrize("name", ["1", "3"])
def test_the_only_annotated_photo_holds_for_all(group, tool, name, caplog):
    if tool == "picture":
        draw(group, f"masks/{name}.png")
    elif tool == "labelme":
        (group / f"{name}.json").write_text(json.dumps(labelme(imagePath=f"{name}.png")))
    else:
        (group / "x.json").write_text(json.dumps(many([name], tool)))
    assert list_groups(group.parents[1]) == {"train": [group]}
    with caplog.at_level(logging.WARNING):
        equal(read(group), BOX, BOX, BOX)
    (line,) = [record.getMessage() for record in caplog.records]
    assert f"the mask of {name}.png, the only photo that has one, holds for the 2 photos without" in line
    for rows in (
        load_gift_i(group.parents[1], "train"),
        datasets.load_dataset("gift_i", data_dir=str(group.parents[1]), split="train"),
    ):
        equal([np.asarray(mask) > 0 for mask in rows[0]["masks"]], BOX, BOX, BOX)


def test_a_mask_for_the_group(group, caplog):
    draw(group, "mask.PNG")
    draw(group, "masks/2.png", OTHER)  # its own mask wins
    with caplog.at_level(logging.WARNING):
        equal(read(group), BOX, OTHER, BOX)
    assert "mask.PNG holds for the 2 photos without an annotation" in caplog.text
    draw(group, "mask.tif")
    with pytest.raises(ValueError, match=r"mask\.PNG and mask\.tif: two masks for all photos of a group; keep one"):
        read(group)


def test_a_mask_for_the_group_by_labelme(group):
    (group / "mask.json").write_text(json.dumps(labelme(imagePath="..\\any.png")))
    equal(read(group), BOX, BOX, BOX)
    (group / "mask.json").write_text('{"fx": 600}')
    with pytest.raises(FileNotFoundError, match="missing mask"):
        read(group)


SOME = {
    "coco": lambda g: (g / "x.json").write_text(json.dumps(many("13"))),
    "never labeled": lambda g: (g / "x.json").write_text(json.dumps(many("13", "label studio"))),
    "a picture": lambda g: [draw(g, f"masks/{name}.png", BOX & (name != "2")) for name in "123"],
    "only one, and an empty one": lambda g: [draw(g, f"masks/{name}.png", BOX & (name == "1")) for name in "12"],
    "a mask for all, and an empty one": lambda g: [draw(g, "mask.png"), draw(g, "masks/2.png", BOX & False)],
    "an empty mask for all": lambda g: [draw(g, "mask.png", BOX & False), *(draw(g, f"masks/{n}.png") for n in "13")],
    "labelme without shapes": lambda g: [
        draw(g, "masks/1.png"),
        (g / "2.json").write_text(json.dumps({"shapes": [], "imagePath": "2.png"})),
    ],
    "of another label": lambda g: [
        (g / "group.yml").write_text("mask_class: glass"),
        (g / "x.json").write_text(
            json.dumps(many("13") | {"annotations": [*many("13")["annotations"], other_category()]})
        ),
    ],
}


def other_category():
    return {"image_id": 2, "category_id": 1, "bbox": [0, 0, 2, 2]}


@pytest.mark.parametrize("name", SOME)
def test_some_without_a_target_are_refused_or_allowed(group, name):
    SOME[name](group)
    if name in ("only one, and an empty one", "labelme without shapes"):  # 3 has no mask, and none may stand in for it
        for choice in ("refuse", "allow"):
            with pytest.raises(FileNotFoundError, match=r"missing mask .*masks/3\.png"):
                read(group, empty_masks=choice)
        return
    for split in ("train", "validation"):
        with pytest.raises(
            ValueError, match=r"scene: 2\.png \(.*has no target .* say so: `empty_masks: allow`"
        ) as error:
            read(group, split)
        assert "\n" not in str(error.value) and "--empty-masks allow" in str(error.value)
    equal(read(group, empty_masks="allow"), BOX, BOX & False, BOX)
    with open(group / "group.yml", "a") as file:
        file.write("\nempty_masks: allow\n")
    equal(read(group), BOX, BOX & False, BOX)


@pytest.mark.parametrize("how", ["skipped", "counted as skipped", "submitted empty"])
def test_a_task_that_somebody_closed_is_not_filled(group, how):
    content = many("1", "label studio")
    content[1] |= {
        "skipped": {"annotations": [{"was_cancelled": True, "result": []}]},
        "counted as skipped": {"annotations": [], "cancelled_annotations": 1},
        "submitted empty": {"annotations": [{"result": []}]},
    }[how]
    (group / "x.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"2\.png \(x\.json\), 3\.png \(x\.json\) have no target in their mask"):
        read(group)


def test_nobody_labeled_anything(group):
    (group / "x.json").write_text(json.dumps(many("")))
    for split in ("train", "validation"):
        with pytest.raises(ValueError, match=r"1\.png \(x\.json\), 2\.png .* have no target"):
            read(group, split)
    with pytest.raises(ValueError, match="every mask is empty"):
        read(group, empty_masks="allow")
    for name in "123":
        draw(group, f"masks/{name}.png", BOX & False)
    assert not np.any(read(group, "validation"))  # drawn, and nothing to be seen in any of them


def test_choices_are_checked_and_are_other_datasets(group):
    (group / "x.json").write_text(json.dumps(many("13")))
    raw = str(group.parents[1])
    with pytest.raises(ValueError, match="has no target"):
        load_gift_i(raw, "train")
    allowed = (
        load_gift_i(raw, "train", empty_masks="allow"),
        datasets.load_dataset("gift_i", data_dir=raw, split="train", empty_masks="allow"),
    )
    for rows in allowed:
        equal([np.asarray(mask) > 0 for mask in rows[0]["masks"]], BOX, BOX & False, BOX)
    with pytest.raises(ValueError, match="has no target"):
        load_gift_i(raw, "train")
    (group / "group.yml").write_text("empty_masks: perhaps")
    with pytest.raises(ValueError, match=r"group\.yml: empty_masks 'perhaps'; it is one of refuse, allow"):
        read(group)
    (group / "group.yaml").write_text("")
    with pytest.raises(ValueError, match=r"group\.yaml and group\.yml: one of them is enough"):
        read(group)
