"""Surface targets beside the proxies: what is stored, kept, refused and made again."""

import os
import shutil
import signal

import numpy as np
import pytest
import torch
from accelerate import PartialState, debug_launcher
from helpers.records import one_line
from helpers.runs import run_in_child
from helpers.tiny import SIZE, tiny_processor, write_base, write_group, write_raw_tree
from PIL import Image

from gift_peft.cli import main
from gift_peft.dataset import proxies as stored
from gift_peft.dataset.cache import GroupCache
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.proxies import SurfaceSettings, read_header
from gift_peft.dataset.tensors import collate_group
from gift_peft.models.loading import DepthModel
from gift_peft.models.pixels import resize_mask, to_pixel_values
from gift_peft.surface_targets import paint_fills, surface_target
from gift_peft.training import teacher
from gift_peft.training.teacher import make_proxies

TWO = SurfaceSettings(fills=2, seed=3)
TARGETS = ["train/scene_0", "train/scene_1", "validation/scene_100"]

pytestmark = pytest.mark.usefixtures("fresh_cache")


def targets(folder):
    """Contents of all surface targets under a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*.surface.safetensors"))}


def expected_target(model, row, settings, flip, kind="inverse_depth"):
    """In one straight line: predictions of the photos and of their fills, then the rule."""
    turn = slice(None, None, -1) if flip else slice(None)

    def predict(images):
        pixels = to_pixel_values(images, tiny_processor(), SIZE)
        return DepthModel(model).predict(pixels.flip(-1) if flip else pixels)

    masks = [np.asarray(mask) > 0 for mask in row["masks"]]
    fills = [
        predict(
            [Image.fromarray(fill) for fill in paint_fills(np.asarray(image), mask, settings.fills, settings.seed)]
        )
        for image, mask in zip(row["images"], masks, strict=True)
    ]
    small = np.stack([resize_mask(mask, SIZE)[:, turn] for mask in masks])
    own = predict(row["images"])
    found = surface_target(own.numpy(), small, fills=torch.stack(fills).numpy(), kind=kind, quantile=0.65, tau=0.5)
    return own, torch.from_numpy(small), torch.from_numpy(found.depth).float()


@pytest.mark.parametrize("kind", ["relative", "metric"])
def test_targets_are_the_rule_on_the_teachers_predictions(tmp_path, raw_tree, kind):
    base = write_base(tmp_path / "base", depth_estimation_type=kind, max_depth=20)
    folder = make_proxies(base, raw_tree, size=SIZE, surface=TWO)
    assert list(targets(folder)) == [f"{name}.surface.safetensors" for name in TARGETS]
    model = DepthModel.from_pretrained(base).network
    for row in load_gift_i(raw_tree, "train", teacher=base, size=SIZE, surface=TWO):
        for flip, name in ((False, "surface_target"), (True, "surface_target_flipped")):
            what = "depth" if kind == "metric" else "inverse_depth"
            own, mask, expected = expected_target(model, row, TWO, flip, what)
            assert torch.equal(row[name], expected)
            assert torch.equal(row[name][~mask], own[~mask]), "outside of the mask it is the teacher's prediction"
            assert not torch.equal(row[name][mask], own[mask])
        assert torch.equal(row["proxies"], expected_target(model, row, TWO, False)[0])
    header = read_header(folder / "train/scene_1.surface.safetensors")
    assert header["format"] == "gift-peft surface targets 1" and header["rule"] == "surface 1"
    assert (header["fills"], header["seed"], header["surface_model"]) == (2, 3, "auto")
    assert (header["surface_quantile"], header["surface_tau"], header["size"]) == (0.65, 0.5, "56x70")
    assert len(header["images"]) == len(header["masks"]) == 3
    assert header["kind"] == ("depth" if kind == "metric" else "inverse_depth")


def test_rows_and_groups_have_targets_only_when_asked(raw_tree, base_dir, tmp_path):
    make_proxies(base_dir, raw_tree, size=SIZE, surface=TWO)
    plain = load_gift_i(raw_tree, "train", teacher=base_dir)
    assert "surface_target" not in plain[0] and collate_group(plain[0], tiny_processor(), SIZE).surface_target is None
    rows = load_gift_i(raw_tree, "train", teacher=base_dir, surface=TWO)
    assert rows[1]["surface_target"].shape == rows[1]["surface_target_flipped"].shape == (3, *SIZE)
    direct = collate_group(rows[1], tiny_processor(), SIZE)
    cache = GroupCache(rows, tiny_processor(), SIZE, tmp_path / "cache")
    for _ in range(2):  # decoded, then from the file
        group = cache.read(1)
        assert torch.equal(group.surface_target, direct.surface_target)
        for number, name in enumerate(group.names):
            image = cache.read(1, number)
            assert image.names == [name] and image.target is None and image.reference_pixel_values is None
            part = slice(number, number + 1)
            assert torch.equal(image.pixel_values, group.pixel_values[part])
            assert torch.equal(image.mask, group.mask[part])
            assert torch.equal(image.surface_target, group.surface_target[part])
            assert torch.equal(image.surface_target_flipped, group.surface_target_flipped[part])
    with pytest.raises(FileNotFoundError) as excinfo:
        make_proxies(base_dir, raw_tree, size=SIZE, proxies_dir=tmp_path / "other")
        load_gift_i(raw_tree, "train", teacher=base_dir, proxies_dir=tmp_path / "other", surface=TWO)[0]
    one_line(excinfo, "missing surface target", "scene_0.surface.safetensors", "--target surface --fills 2 --seed 3`")


@pytest.mark.parametrize("fills", [0, 1])
def test_groups_of_one(base_dir, tmp_path, fills):
    raw = write_raw_tree(tmp_path / "raw", train=(1, 2), validation=(1,))
    settings = SurfaceSettings(fills=fills, surface_model="quantile")
    make_proxies(base_dir, raw, size=SIZE, surface=settings)
    row = load_gift_i(raw, "train", teacher=base_dir, surface=settings)[0]
    assert row["surface_target"].shape == (1, *SIZE)
    assert torch.allclose(row["surface_target"], row["proxies"]) == (fills == 0)


# ---- what no longer holds ----

CHANGES = {"fills": 3, "seed": 4, "surface_model": "plane", "surface_quantile": 0.7, "surface_tau": 0.6}


@pytest.mark.parametrize("name", CHANGES)
def test_targets_made_with_other_settings_are_refused(raw_tree, base_dir, name):
    folder = make_proxies(base_dir, raw_tree, size=SIZE, splits=["train"], surface=TWO)
    other = SurfaceSettings(**{**vars(TWO), name: CHANGES[name]})
    path = folder / "train/scene_0.surface.safetensors"
    for use in (
        lambda: load_gift_i(raw_tree, "train", teacher=base_dir, surface=other)[0],
        lambda: make_proxies(base_dir, raw_tree, size=SIZE, splits=["train"], surface=other),
    ):
        with pytest.raises(ValueError) as excinfo:
            use()
        said = f"stale surface target {path}: it was made with {name} {getattr(TWO, name)}, not {CHANGES[name]}; "
        one_line(excinfo, said, "--target surface", f"--{name} {CHANGES[name]}", "--overwrite`")


def other_mask(raw, monkeypatch):
    mask = np.zeros((60, 80), np.uint8)
    mask[3:40, 4:50] = 255
    Image.fromarray(mask).save(raw / "train/scene_0/masks/1.png")


def other_photo(raw, monkeypatch):
    Image.new("RGB", (80, 60), (9, 8, 7)).save(raw / "train/scene_0/0.png")


STALE = {
    "rule": (lambda raw, patch: patch.setattr(stored, "RULE", "surface 2"), "rule surface 1, not surface 2"),
    "mask": (other_mask, "the mask of 1.png has changed since"),
    "photo": (other_photo, "image 0.png has changed since"),
}


@pytest.mark.parametrize("name", STALE)
def test_a_changed_rule_mask_or_photo_makes_targets_stale(raw_tree, base_dir, monkeypatch, name):
    change, reason = STALE[name]
    folder = make_proxies(base_dir, raw_tree, size=SIZE, splits=["train"], surface=TWO)
    before = targets(folder)
    change(raw_tree, monkeypatch)
    if name == "photo":  # its proxy is stale too, and told first
        make_proxies(base_dir, raw_tree, size=SIZE, splits=["train"], overwrite=True)
    times = {path: path.stat().st_mtime_ns for path in folder.rglob("scene_?.safetensors")}
    for use in (
        lambda: load_gift_i(raw_tree, "train", teacher=base_dir, surface=TWO)[0],
        lambda: make_proxies(base_dir, raw_tree, size=SIZE, splits=["train"], surface=TWO),
    ):
        with pytest.raises(ValueError) as excinfo:
            use()
        one_line(excinfo, "stale surface target", reason, "--target surface", "--overwrite`")
    make_proxies(base_dir, raw_tree, size=SIZE, splits=["train"], surface=TWO, overwrite=True)
    assert targets(folder) != before
    assert times == {path: path.stat().st_mtime_ns for path in times}, "proxies that hold are kept"
    assert load_gift_i(raw_tree, "train", teacher=base_dir, surface=TWO)[0]["surface_target"] is not None


def test_another_teacher_or_kind(raw_tree, base_dir, tmp_path):
    base = shutil.copytree(base_dir, tmp_path / "base")
    make_proxies(base, raw_tree, size=SIZE, surface=TWO)
    with pytest.raises(ValueError, match=r"stale surface target .*made with kind"):
        make_proxies(base, raw_tree, surface=TWO, size=SIZE, kind="depth")
    for path in (raw_tree / "proxies").rglob("scene_?.safetensors"):
        path.unlink()
    shutil.rmtree(base)
    write_base(base, seed=1)
    with pytest.raises(ValueError, match=r"stale surface target .*made with model or revision"):
        make_proxies(base, raw_tree, size=SIZE, surface=TWO)


def test_damaged_targets(raw_tree, base_dir):
    folder = make_proxies(base_dir, raw_tree, size=SIZE, surface=TWO)
    path = folder / "train/scene_0.surface.safetensors"
    shutil.copy(folder / "train/scene_0.safetensors", path)
    with pytest.raises(ValueError, match=r"damaged surface target .*not a surface target file.*--overwrite"):
        load_gift_i(raw_tree, "train", teacher=base_dir, surface=TWO)[0]
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ValueError, match=r"damaged surface target .*--target surface"):
        make_proxies(base_dir, raw_tree, size=SIZE, surface=TWO)


# ---- stopped, shared, odd ----


def test_finished_groups_are_kept(raw_tree, base_dir, monkeypatch):
    folder = make_proxies(base_dir, raw_tree, size=SIZE, surface=TWO)
    before = targets(folder)
    (folder / f"{TARGETS[1]}.surface.safetensors").unlink()
    asked = []
    made = teacher._surface_row
    monkeypatch.setattr(teacher, "_surface_row", lambda *args: asked.append(args[1].group_id) or made(*args))
    make_proxies(base_dir, raw_tree, size=SIZE, surface=TWO)
    assert asked == ["scene_1"] and targets(folder) == before


def test_a_kill_leaves_no_broken_file(raw_tree, base_dir, tmp_path):
    whole = targets(make_proxies(base_dir, raw_tree, size=SIZE, proxies_dir=tmp_path / "whole", surface=TWO))
    folder = make_proxies(base_dir, raw_tree, size=SIZE)
    sync, calls = os.fsync, []

    def killed():
        """Dies when half of the second group's file is on disk."""

        def fsync(descriptor):
            calls.append(descriptor)
            if len(calls) == 2:
                os.ftruncate(descriptor, 1000)
                os.kill(os.getpid(), signal.SIGKILL)
            sync(descriptor)

        os.fsync = fsync
        PartialState._reset_state()
        make_proxies(base_dir, raw_tree, size=SIZE, surface=TWO)

    assert run_in_child(killed) == -signal.SIGKILL
    assert len(targets(folder)) == 1 and targets(folder).items() <= whole.items()
    make_proxies(base_dir, raw_tree, size=SIZE, surface=TWO)
    assert targets(folder) == whole and not list(folder.rglob(".*.partial"))


def _make_in_two(base, raw, proxies):
    PartialState._reset_state()
    PartialState(cpu=True)
    make_proxies(base, raw, size=SIZE, proxies_dir=proxies, surface=TWO)


def test_two_processes_make_the_same_files(base_dir, tmp_path):
    raw = write_raw_tree(tmp_path / "raw", train=(2, 1, 3), validation=(1,))
    alone = make_proxies(base_dir, raw, size=SIZE, proxies_dir=tmp_path / "one", surface=TWO)
    debug_launcher(_make_in_two, (base_dir, raw, tmp_path / "two"), num_processes=2)
    assert targets(tmp_path / "two" / alone.parent.name / alone.name) == targets(alone) and len(targets(alone)) == 4


def test_nothing_to_teach_and_names_that_clash(raw_tree, base_dir):
    """A target that no pixel of the network's size sees, validation without a mask, a mask over the whole photo."""
    point, everything = np.zeros((60, 80), np.uint8), np.full((60, 80), 255, np.uint8)
    lost = next(row for row in range(60) if row not in {(2 * new + 1) * 60 // 112 for new in range(56)})
    point[lost, 7] = 255
    for path in (raw_tree / "train/scene_0/masks").iterdir():
        Image.fromarray(point).save(path)
    for path in (raw_tree / "train/scene_1/masks").iterdir():
        Image.fromarray(everything).save(path)
    for path in (raw_tree / "validation/scene_100/masks").iterdir():
        Image.fromarray(point * 0).save(path)
    make_proxies(base_dir, raw_tree, size=SIZE, surface=TWO)
    for split, index in (("train", 0), ("validation", 0)):
        row = load_gift_i(raw_tree, split, teacher=base_dir, surface=TWO)[index]
        assert torch.equal(row["surface_target"], row["proxies"])
    assert load_gift_i(raw_tree, "train", teacher=base_dir, surface=TWO)[1]["surface_target"].isfinite().all()
    write_group(raw_tree / "train/scene_0.surface", 2, 7)
    with pytest.raises(ValueError, match=r"group scene_0\.surface: rename it"):
        make_proxies(base_dir, raw_tree, size=SIZE, surface=TWO, overwrite=True)


def test_a_bad_prediction_names_group_and_image(raw_tree, base_dir, monkeypatch):
    make_proxies(base_dir, raw_tree, size=SIZE)
    bad = lambda self, pixels, size=2: torch.full((len(pixels), *SIZE), np.nan)  # noqa: E731
    monkeypatch.setattr(DepthModel, "predict_proxies", bad)
    with pytest.raises(ValueError) as excinfo:
        make_proxies(base_dir, raw_tree, size=SIZE, surface=TWO)
    one_line(excinfo, "group scene_0, 0.png", "flipped", "NaN")


def test_the_verb(raw_tree, base_dir, capsys):
    places = ["--base", str(base_dir), "--dataset", str(raw_tree), "--size", "56x70"]
    for bad, words in (
        (["--fills", "3"], "--target surface"),
        (["--target", "surface", "--fills", "-1"], "fills"),
        (["--target", "surface", "--surface_tau", "1"], "surface_tau"),
    ):
        with pytest.raises(SystemExit) as ended:
            main(["proxies", *places, *bad])
        assert ended.value.code and words in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        main(["proxies", *places, "--target", "surface", "--fills", "1", "--surface_model", "quantile"])
    assert ended.value.code == 0
    assert "Surface targets: " in capsys.readouterr().out
    settings = SurfaceSettings(fills=1, surface_model="quantile")
    assert load_gift_i(raw_tree, "train", teacher=base_dir, surface=settings)[0]["surface_target"] is not None
