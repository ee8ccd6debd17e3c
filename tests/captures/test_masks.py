"""What `find_mask` takes and refuses: masks in every form, in every place, and broken ones."""

import base64
import copy
import io
import json
import os
from pathlib import Path

import numpy as np
import pytest
from helpers.drawn_masks import (
    BOX,
    CORNERS,
    POLYGON,
    SIZE,
    coco,
    compressed,
    labelme,
    packed,
    percent,
    picture,
    region,
    run_lengths,
    tasks,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from gift_peft.captures.masks import MaskSource, find_mask, is_mask_file


@pytest.fixture
def group(tmp_path) -> Path:
    """RAW/train/scene with an image 1.jpg and no mask."""
    folder = tmp_path / "raw" / "train" / "scene"
    folder.mkdir(parents=True)
    Image.new("RGB", SIZE).save(folder / "1.jpg")
    return folder


def look(group: Path, mask_class=None, image="1.jpg") -> MaskSource | None:
    return find_mask(group / image, group, group.parents[1], mask_class)


def write(path: Path, content) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, np.ndarray):
        Image.fromarray(content).save(path)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


GOOD = {
    "png": ("masks/1.png", picture()),
    "png of zeros and ones": ("masks/1.png", BOX.astype(np.uint8)),
    "png beside": ("1_mask.png", picture()),
    "labelme polygon": ("1.json", labelme()),
    "labelme rectangle": ("1.json", labelme([[9, 6], [3, 2]], "rectangle")),
    "labelme without sizes": ("masks/1.json", {"shapes": labelme()["shapes"]}),
    "labelme in annotations": ("annotations/1.json", labelme(imagePath="../1.jpg")),
    "labelme of Windows": ("annotations/1.json", labelme(imagePath="..\\images\\1.jpg")),
    "labelme of another machine": ("masks/1.json", labelme(imagePath="C:\\Users\\me\\1.jpg")),
    "labelme absolute": ("1.json", labelme(imagePath="/home/me/1.jpg")),
    "coco polygon": ("annotations/instances_default.json", coco(segmentation=[POLYGON])),
    "coco two polygons": ("x.json", coco(segmentation=[POLYGON, [4, 3, 5, 3, 5, 5]])),
    "coco run lengths": ("x.json", coco(segmentation={"size": [8, 12], "counts": run_lengths(BOX)}, iscrowd=1)),
    "coco compressed": ("x.json", coco(segmentation={"size": [8, 12], "counts": compressed(run_lengths(BOX))})),
    "coco box": ("x.json", coco()),
    "coco of Label Studio": ("result.json", coco("images\\0a1b2c3d-1.jpg")),
    "coco at the root": ("../../annotations/instances_default.json", coco("scene/1.jpg")),
    "coco at the split": ("../all.json", coco("elsewhere/train/scene/1.jpg")),
    "label studio polygon": ("x.json", tasks(region(points=percent(CORNERS)))),
    "label studio rectangle": (
        "x.json",
        tasks(region("rectanglelabels", x=25, y=25, width=50, height=50, rotation=0)),
    ),
    "label studio brush": (
        "x.json",
        tasks(region("brushlabels", rle=packed(np.repeat(picture().ravel(), 4), runs=True), format="rle")),
    ),
    "label studio local files": (
        "../../x.json",
        tasks(region(points=percent(CORNERS)), image="/data/local-files/?d=train/scene/1.jpg"),
    ),
}


@pytest.mark.parametrize("name", GOOD)
def test_forms(group, name):
    path, content = GOOD[name]
    path = write(group / path, content)
    source = look(group)
    np.testing.assert_array_equal(source.read(SIZE), BOX)
    assert source.path.resolve() == path.resolve() and source.files == (source.path,)


def test_labelme_circle_and_stored_mask(group):
    write(group / "1.json", labelme([[6, 4], [9, 4]], "circle"))
    expected = [[(x - 5.5) ** 2 + (y - 3.5) ** 2 < 9 for x in range(SIZE[0])] for y in range(SIZE[1])]
    np.testing.assert_array_equal(look(group).read(SIZE), expected)
    buffer = io.BytesIO()
    Image.fromarray(BOX[2:6, 3:9]).save(buffer, "PNG")
    content = labelme([[3, 2], [8, 5]], "mask")
    content["shapes"][0]["mask"] = base64.b64encode(buffer.getvalue()).decode()
    write(group / "1.json", content)
    np.testing.assert_array_equal(look(group).read(SIZE), BOX)


def test_one_label_is_the_target_and_several_need_a_class(group):
    content = labelme()
    table = {"label": "table", "points": [[0, 0], [12, 0], [12, 8], [0, 8]], "shape_type": "polygon"}
    content["shapes"].insert(0, table)  # below the glass
    write(group / "1.json", content)
    with pytest.raises(ValueError, match=r"1\.json: 2 labels \(table, glass\); name the target's"):
        look(group).read(SIZE)
    np.testing.assert_array_equal(look(group, "glass").read(SIZE), BOX)
    assert look(group, ["glass", "table"]).read(SIZE).all()
    with pytest.raises(ValueError, match=r"1\.json: mask_class 'mirror' is none of the labels there \(table, glass\)"):
        look(group, "mirror").read(SIZE)


def test_coco_classes(group):
    content = coco(segmentation=[POLYGON])
    content["images"].append({"id": 6, "file_name": "2.jpg", "width": SIZE[0], "height": SIZE[1]})
    content["annotations"].append({"image_id": 6, "category_id": 1, "bbox": [0, 0, 12, 8]})
    write(group / "x.json", content)
    with pytest.raises(
        ValueError, match=r"image 1\.jpg: 2 categories \(table, glass\)"
    ):  # used in the file, if not here
        look(group).read(SIZE)
    for target in ("glass", 2, [2, 9]):
        np.testing.assert_array_equal(look(group, target).read(SIZE), BOX)
    assert not look(group, "table").read(SIZE).any()  # a known category that is not in this image


def test_png_with_several_values_needs_a_class(group):
    write(group / "masks/1.png", np.where(BOX, 7, np.arange(12) % 3).astype(np.uint8))
    with pytest.raises(ValueError, match=r"masks/1\.png: 4 different values"):
        look(group).read(SIZE)
    np.testing.assert_array_equal(look(group, 7).read(SIZE), BOX)
    with pytest.raises(ValueError, match=r"mask_class 'glass' is a label, and this mask holds numbers"):
        look(group, "glass").read(SIZE)


@pytest.mark.parametrize("place", ["", "masks/", "../", "../../"])
def test_cvat_pictures(group, place):
    """Its folders in the group's, in `masks/`, or above, where the names keep the group's folder."""
    base = group / place
    colours = np.where(BOX[..., None], (128, 0, 64), (0, 0, 0)).astype(np.uint8)
    name = {"../": "scene/1.png", "../../": "train/scene/1.png"}.get(place, "1.png")
    path = write(base / "SegmentationClass" / name, colours)
    labelmap = "# label:color_rgb:parts:actions\nbackground:0,0,0::\nglass:128,0,64::\n"
    write(path.parent.parent / "labelmap.txt", labelmap)
    source = look(group)
    np.testing.assert_array_equal(source.read(SIZE), BOX)
    assert source.files == (source.path, source.path.parents[1] / "labelmap.txt")
    write(path.parent.parent / "labelmap.txt", labelmap + "table:0,0,9::\n")
    with pytest.raises(ValueError, match=r"2 labels of .*labelmap\.txt \(glass, table\)"):
        look(group).read(SIZE)
    np.testing.assert_array_equal(look(group, "glass").read(SIZE), BOX)
    write(path.parent.parent / "labelmap.txt", "background:0,0,0::\nglass:1,1,1::\n")
    with pytest.raises(ValueError, match=r"1 colours that .*labelmap\.txt does not name"):
        look(group).read(SIZE)


def labelme_at(path):
    return labelme(imagePath=path)


BAD = {
    "other size": ("masks/1.png", picture(BOX.T), "masks/1.png: the mask is 12x8"),
    "truncated": ("masks/1.png", "\x89PNG", "masks/1.png: not a readable image"),
    "colours": ("masks/1.png", np.full((8, 12, 3), (9, 0, 0), np.uint8), "masks/1.png: mode RGB"),
    "labelme other size": ("1.json", labelme(imageWidth=13), "1.json: its shapes are for 8x13"),
    "labelme other image": ("1.json", labelme_at("2.jpg"), "1.json: drawn on 2.jpg, not on 1.jpg"),
    "labelme other, climbs": (
        "annotations/1.json",
        labelme_at("..\\1\\2.jpg"),
        r"drawn on ..\\1\\2.jpg, not on 1.jpg",
    ),
    "labelme other, absolute": ("masks/1.json", labelme_at("/etc/1.jpg/passwd"), "drawn on /etc/1.jpg/passwd"),
    "labelme no name": ("1.json", labelme_at(7), "1.json: imagePath: 7 is not an image's name"),
    "labelme cut short": ("1.json", '{"shapes": [', "1.json: not valid JSON, or cut short"),
    "labelme no label": ("1.json", labelme(label=None), "1.json: a shape, region or category without a label"),
    "labelme line": ("1.json", labelme(CORNERS[:2], "line"), "type 'line' with 2 points has no area"),
    "labelme two corners": ("1.json", labelme(CORNERS[:2]), "with 2 points has no area"),
    "labelme NaN": ("1.json", labelme([[float("nan"), 1], [2, 2], [3, 3]]), "not a number within reason"),
    "labelme shapes": ("1.json", labelme(shapes={}), "1.json: its shapes are not a list"),
    "labelme points": ("1.json", labelme("no"), "not pairs of numbers"),
    "coco other size": ("x.json", coco(segmentation={"size": [9, 12], "counts": [0]}), r"size \[9, 12\]"),
    "coco short": ("x.json", coco(segmentation={"size": [8, 12], "counts": [3, 4]}), "cover 7 pixels, but .* 96"),
    "coco negative": ("x.json", coco(segmentation={"size": [8, 12], "counts": [98, -2]}), "whole numbers from 0"),
    "coco string": ("x.json", coco(segmentation={"size": [8, 12], "counts": "é"}), "compressed run lengths hold 'é'"),
    "coco string end": ("x.json", coco(segmentation={"size": [8, 12], "counts": "P"}), "middle of a number"),
    "coco odd": ("x.json", coco(segmentation=[[1, 2, 3]]), "odd length"),
    "coco nothing": ("x.json", coco(bbox=None), "neither a segmentation nor a box"),
    "coco category": ("x.json", coco(category_id=9), "x.json: an annotation of category 9, which is not listed"),
    "coco image": ("x.json", coco(image_id=9), "x.json: an annotation for image id 9, which is not listed"),
    "coco without a name": ("x.json", coco("../.."), r"x.json: '\.\./\.\.' is not an image's name"),
    "label studio size": ("x.json", tasks(region(points=CORNERS) | {"original_width": 9}), "an image of 9x8"),
    "label studio no area": ("x.json", tasks(region("keypointlabels", x=1, y=2)), "'keypointlabels' has no area"),
    "label studio no label": ("x.json", tasks(region() | {"value": {"points": CORNERS}}), "without a label"),
    "label studio cut": ("x.json", tasks(region("brushlabels", rle=[0, 0, 1, 128])), "cut short"),
    "label studio count": ("x.json", tasks(region("brushlabels", rle=packed(np.zeros(9, int), True))), "9 values"),
    "label studio bytes": ("x.json", tasks(region("brushlabels", rle=[1, 999])), "not bytes"),
    "label studio pictures": ("masks/task-1-annotation-2-by-1-tag-glass-0.png", picture(), "rename it to 1_mask.png"),
}


@pytest.mark.parametrize("name", BAD)
def test_refusals_name_the_file(group, name):
    path, content, message = BAD[name]
    write(group / path, content)
    with pytest.raises(ValueError, match=message) as error:
        look(group).read(SIZE)
    assert path.rpartition("/")[2] in str(error.value) and "\n" not in str(error.value)


def places(content, at=()):
    """Paths to every value of a JSON document."""
    yield at
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        if isinstance(value, dict | list):
            yield from places(value, (*at, key))
        else:
            yield (*at, key)


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@given(st.data(), st.sampled_from(["labelme polygon", "coco polygon", "coco compressed", "label studio polygon"]))
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_an_export_holds_it_is_a_mask_or_one_line(group, data, name):
    path, content = GOOD[name]
    content = copy.deepcopy(content)
    *at, key = data.draw(st.sampled_from([place for place in places(content) if place]))
    inner = content
    for step in at:
        inner = inner[step]
    inner[key] = data.draw(anything)
    write(group / path, content)
    try:
        source = look(group)
        mask = None if source is None else source.read(SIZE)
    except ValueError as error:
        assert Path(path).name in str(error) and "\n" not in str(error)
    else:
        assert mask is None or (mask.shape == BOX.shape and mask.dtype == bool)
    finally:
        (group / path).unlink()


def test_the_first_form_counts(group):
    write(group / "x.json", coco())
    write(group / "1.json", labelme([[0, 0], [12, 0], [12, 8], [0, 8]]))
    assert look(group).kind == "labelme"
    write(group / "1_mask.png", picture())
    assert look(group).path.name == "1_mask.png"
    write(group / "masks/1.png", picture())
    assert look(group).path == group / "masks/1.png"


def test_nothing_and_things_that_are_no_masks(group):
    assert look(group) is None
    write(group / "1.json", {"exposure": 4})  # a camera's notes
    write(group / "camera.json", {"fx": 600})
    write(group / "x.json", coco("other.jpg"))
    write(group.parents[2] / "x.json", coco("raw/train/scene/1.jpg"))  # outside the root
    assert look(group) is None


def test_one_name_for_several_images_is_refused(group):
    for folder in ("a", "b"):
        write(group / folder / "3.png", np.zeros((8, 12, 3), np.uint8))
    write(group / "masks/3.png", picture())
    with pytest.raises(ValueError, match=r"masks/3\.png may belong to several images called 3"):
        look(group, image="a/3.png")
    write(group / "masks/a/3.png", picture())
    assert look(group, image="a/3.png").path == group / "masks/a/3.png"
    (group / "masks/3.png").unlink()
    write(group / "x.json", coco("3.png"))
    with pytest.raises(ValueError, match=r"x\.json: 3\.png may mean several images"):
        look(group, image="b/3.png")
    write(group / "x.json", coco("b/3.png"))
    np.testing.assert_array_equal(look(group, image="b/3.png").read(SIZE), BOX)


def test_accents_match_however_they_are_written(group):
    Image.new("RGB", SIZE).save(group / "e\u0301.jpg")  # e and accent apart, as macOS stores it
    write(group / "x.json", coco("\u00e9.jpg"))
    np.testing.assert_array_equal(look(group, image="e\u0301.jpg").read(SIZE), BOX)


def test_a_changed_export_is_read_again(group):
    path = write(group / "x.json", coco())
    source = look(group)
    np.testing.assert_array_equal(source.read(SIZE), BOX)
    write(path, coco(bbox=[0, 0, 12, 8]))
    os.utime(path, ns=(1, 1))
    assert source.read(SIZE).all()


def test_which_pictures_are_masks(group):
    for name in ("2.jpg", "gas_mask.png", "1_mask.png", "masks/1.png", "SegmentationObject/1.png"):
        write(group / name, picture())
    names = ("1.jpg", "2.jpg", "gas_mask.png", "1_mask.png", "masks/1.png", "SegmentationObject/1.png")
    assert [is_mask_file(group / name, group) for name in names] == [False, False, False, True, True, True]
