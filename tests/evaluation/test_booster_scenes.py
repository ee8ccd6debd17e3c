"""Booster's files: the three root levels, what is wrong with them said by name, ground truth against plain numpy."""

import shutil

import numpy as np
import pytest
from helpers.booster_tree import CALIBRATION, nearest, write_root, write_scene
from PIL import Image

from gift_peft.evaluation.booster_scenes import OFFICIAL_SCENES, find_booster, read_calibration, read_ground_truth


@pytest.fixture
def scene(tmp_path):
    write_scene(tmp_path / "S", images=3)
    return tmp_path / "S"


def read(folder, **options):
    return read_ground_truth(find_booster(folder.parent).scenes[0], **options)


# ---- finding ----


def test_a_root_may_be_any_of_three_levels(tmp_path):
    write_root(tmp_path)
    write_scene(tmp_path / "train" / "unbalanced" / "Scene0", 5)
    for root in (tmp_path, tmp_path / "train", tmp_path / "train" / "balanced"):
        found = find_booster(root)
        assert [scene.name for scene in found.scenes] == ["Scene0", "Scene1"] and found.subset == "balanced"
        assert not found.official
    for root in (tmp_path, tmp_path / "train", tmp_path / "train" / "unbalanced"):
        found = find_booster(root, subset="unbalanced")
        assert [scene.name for scene in found.scenes] == ["Scene0"] and found.subset == "unbalanced"
    with pytest.raises(ValueError, match="holds scenes itself"):
        find_booster(tmp_path / "train" / "balanced", subset="unbalanced")
    with pytest.raises(ValueError, match="unknown subset 'test'"):
        find_booster(tmp_path, subset="test")


def test_layouts_without_balanced_and_hidden_folders(tmp_path):
    write_scene(tmp_path / "train" / "Door10")
    write_scene(tmp_path / "train" / "Door9")
    (tmp_path / "train" / ".cache").mkdir()
    (tmp_path / "train" / "__MACOSX").mkdir()
    for root in (tmp_path, tmp_path / "train"):
        found = find_booster(root)
        assert [scene.name for scene in found.scenes] == ["Door9", "Door10"] and found.subset is None


def test_images_are_in_natural_order(scene):
    shutil.copy(scene / "camera_00" / "im1.png", scene / "camera_00" / "im10.png")
    (scene / "camera_00" / "notes.txt").write_text("")
    names = [image.stem for image in find_booster(scene.parent).scenes[0].images]
    assert names == ["im0", "im1", "im2", "im10"]


def test_roots_and_scenes_without_images(tmp_path, scene):
    with pytest.raises(FileNotFoundError, match="no such folder"):
        find_booster(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"empty: no scenes; expected <Scene>, balanced/<Scene>"):
        find_booster(tmp_path / "empty")
    with pytest.raises(FileNotFoundError, match=r"scene .*empty: no images in camera_00/"):
        find_booster(tmp_path)
    (tmp_path / "empty").rmdir()
    shutil.copy(scene / "camera_00" / "im1.png", scene / "camera_00" / "im1.bmp")
    with pytest.raises(ValueError, match=r"would share one prediction"):
        find_booster(tmp_path)


def official_tree(root, names=OFFICIAL_SCENES, images=228):
    for number, name in enumerate(sorted(names)):
        camera = root / "balanced" / name / "camera_00"
        camera.mkdir(parents=True)
        for index in range(6 if number else 6 + images - 6 * len(OFFICIAL_SCENES)):
            (camera / f"im{index}.png").touch()
    return root


def test_a_root_that_claims_to_be_the_official_set_is_counted(tmp_path):
    assert len(OFFICIAL_SCENES) == 38
    assert find_booster(official_tree(tmp_path / "full")).official
    missing = official_tree(tmp_path / "missing", OFFICIAL_SCENES - {"Mirror"})
    with pytest.raises(ValueError, match=r"37 of 38 scenes and 222 of 228 images; missing: Mirror \("):
        find_booster(missing)
    assert not find_booster(missing, official=False).official
    with pytest.raises(ValueError, match="38 of 38 scenes and 227 of 228 images"):
        find_booster(official_tree(tmp_path / "image", images=227))
    write_scene(tmp_path / "own" / "Kitchen")
    assert not find_booster(tmp_path / "own").official
    with pytest.raises(ValueError, match=r"1 of 38 scenes.*unknown: Kitchen"):
        find_booster(tmp_path / "own", official=True)


# ---- ground truth ----


@pytest.mark.parametrize("size", [(60, 84), (61, 83), (30, 45)])
@pytest.mark.parametrize("resize", [1, 0.5, 0.25])
def test_depth_against_plain_numpy(tmp_path, size, resize):
    written = write_scene(tmp_path / "S", 3, size=size)
    for occlusion in ("all", "noc"):
        truth = read(tmp_path / "S", resize=resize, occlusion=occlusion)
        disparity = nearest(written["disparity"], resize).astype(float)
        depth = np.divide(written["product"], disparity, out=np.zeros(disparity.shape), where=disparity > 0)
        depth[(depth < 1) | (depth > 10000)] = 0
        if occlusion == "noc":
            depth[~nearest(written["visible"], resize)] = 0
        np.testing.assert_allclose(truth.depth, depth, rtol=1e-12)
        assert truth.full_size == size and truth.depth.dtype == np.float64
    np.testing.assert_array_equal(truth.tom, nearest(written["classes"], resize) >= 2)
    if resize == 1:
        assert (depth[:4, :6] == 0).all() and (depth[8:10, :5] == 0).all()


def test_the_focal_length_is_that_of_the_rectified_camera(scene):
    assert read_calibration(scene / "calib_00-02.xml") == (900.5, 63.25)
    (scene / "calib_00-02.xml").rename(scene / "calib_00-01.xml")
    assert read(scene, resize=1).depth.max() > 1000


def test_unknown_disparity(scene):
    disparity = np.load(scene / "disp_00.npy")
    expected = read(scene, resize=1).depth
    disparity[20, :4] = [np.nan, np.inf, -np.inf, -3]
    np.save(scene / "disp_00.npy", disparity)
    expected[20, :4] = 0
    np.testing.assert_array_equal(read(scene, resize=1).depth, expected)


@pytest.mark.parametrize("name", ["disp_00.npy", "mask_cat.png", "mask_00.png", "calib_00-02.xml"])
def test_missing_files_are_named(scene, name):
    (scene / name).unlink()
    with pytest.raises(FileNotFoundError, match=rf"{name}: no such file"):
        read(scene, occlusion="noc")


def test_mask_00_is_not_needed_without_occlusion(scene):
    (scene / "mask_00.png").unlink()
    assert read(scene).depth.any()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("disp_00.npy", "not a readable npy file"),
        ("mask_cat.png", "not a readable image"),
        ("mask_00.png", "not a readable image"),
        ("calib_00-02.xml", "not valid XML"),
    ],
)
def test_damaged_files_are_named(scene, name, message):
    content = (scene / name).read_bytes()
    (scene / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=rf"{name}: {message}"):
        read(scene, occlusion="noc")


def test_odd_files_are_named(scene):
    good = {name: (scene / name).read_bytes() for name in ("disp_00.npy", "mask_cat.png", "mask_00.png")}
    classes = np.asarray(Image.open(scene / "mask_cat.png"))

    def restored(name):
        (scene / name).write_bytes(good[name])

    Image.fromarray(np.where(classes == 3, np.uint8(7), classes)).save(scene / "mask_cat.png")
    with pytest.raises(ValueError, match=r"mask_cat\.png: class 7; the material classes are 0, 1, 2, 3"):
        read(scene)
    Image.fromarray(classes[:-1]).save(scene / "mask_cat.png")
    with pytest.raises(ValueError, match=r"mask_cat\.png is 59x84 .*disp_00\.npy is 60x84"):
        read(scene)
    Image.fromarray(np.stack([classes] * 3, -1)).save(scene / "mask_cat.png")
    with pytest.raises(ValueError, match=r"mask_cat\.png: mode RGB"):
        read(scene)
    restored("mask_cat.png")
    Image.fromarray(classes).save(scene / "mask_00.png")
    with pytest.raises(ValueError, match=r"mask_00\.png: 4 different values"):
        read(scene, occlusion="noc")
    restored("mask_00.png")
    for odd, shown in ((np.zeros((2, 3, 4)), r"float64 \(2, 3, 4\)"), (np.zeros((3, 4), complex), "complex128")):
        np.save(scene / "disp_00.npy", odd)
        with pytest.raises(ValueError, match=rf"disp_00\.npy: {shown}"):
            read(scene)
    np.save(scene / "disp_00.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(ValueError, match=r"disp_00\.npy: not a readable npy file"):
        read(scene)


@pytest.mark.parametrize(
    ("focal", "baseline", "message"),
    [("nan", 60, "proj_matL starts with nan"), (0, 60, "proj_matL starts with 0"),
     (900, -3, "baselineLR starts with -3"),
     (900, "", "baselineLR is missing, or not a number"), ("f", 60, "proj_matL is missing, or not a number")],
)  # fmt: skip
def test_calibrations_that_cannot_be(scene, focal, baseline, message):
    text = CALIBRATION.format(focal=focal, wrong=1, baseline=baseline)
    (scene / "calib_00-02.xml").write_text(text)
    with pytest.raises(ValueError, match=rf"calib_00-02\.xml: {message}"):
        read(scene)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"resize": 0}, "resize 0"), ({"resize": 0.01}, "resize 0.01: no pixel is left of 60x84"),
     ({"resize": 2}, "resize 2"), ({"occlusion": "occ"}, "unknown occlusion 'occ'"),
     ({"tom_classes": ()}, "tom_classes"), ({"tom_classes": (2, 4)}, "tom_classes")],
)  # fmt: skip
def test_wrong_options(scene, options, message):
    with pytest.raises(ValueError, match=message):
        read(scene, **options)
