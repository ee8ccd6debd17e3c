"""What somebody puts or changes in OUT is neither deleted nor replaced by a later `gift-peft prepare`."""

import json
import shutil

import numpy as np
import pytest
from helpers.photos import capture
from PIL import Image

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.prepare import prepare
from gift_peft.prepare.prepare import prepare_gift_i

pytestmark = pytest.mark.usefixtures("fresh_cache")


@pytest.fixture
def places(tmp_path):
    """RAW with two groups, and OUT made of it."""
    for index, name in enumerate(("a", "b")):
        capture(tmp_path / "raw" / name, index, count=2, size=(96, 120))
        (tmp_path / "raw" / name / "group.yaml").write_text("static_rig: true\n")
    prepare_gift_i(tmp_path / "raw", tmp_path / "out")
    return tmp_path / "raw", tmp_path / "out"


def change_raw(raw, name):
    """The group has to be made again."""
    path = raw / name / "masks/0.png"
    mask = np.array(Image.open(path))
    mask[0, 0] = 255 - mask[0, 0]
    Image.fromarray(mask).save(path)


def test_files_beside_a_group_survive_its_making_and_its_end(places):
    raw, out = places
    for name in ("train/a/notes.txt", "train/a/images/mine.jpg", "masks_proposed/train/a/mine.png"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(name)
    change_raw(raw, "a")
    report = prepare_gift_i(raw, out)
    assert [entry["status"] for entry in report["groups"]] == ["kept", "kept"]
    shutil.rmtree(raw / "a")
    assert prepare_gift_i(raw, out)["removed"] == ["train/a"]
    left = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file() and "/a/" in str(path))
    assert left == ["masks_proposed/train/a/mine.png", "train/a/images/mine.jpg", "train/a/notes.txt"]
    assert all((out / name).read_text() == name for name in left)


def test_a_mask_edited_in_out_is_not_replaced(places):
    raw, out = places
    mask = next((out / "train/a/masks").iterdir())
    Image.fromarray(np.random.default_rng(0).integers(0, 2, (96, 120), np.uint8) * 255).save(mask)
    before = mask.read_bytes()
    rows = (out / "train/metadata.parquet").read_bytes()
    with pytest.raises(ValueError, match=rf"{mask}: not written by gift-peft prepare, or changed since") as error:
        prepare_gift_i(raw, out)
    assert "\n" not in str(error.value)
    assert mask.read_bytes() == before
    mask.unlink()  # as the line says
    prepare_gift_i(raw, out)
    assert mask.read_bytes() != before and (out / "train/metadata.parquet").read_bytes() == rows


def test_a_group_of_somebody_is_not_taken_over(places):
    raw, out = places
    theirs = out / "train/c/images/00_0.png"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("mine")
    capture(raw / "c", 7, count=2, size=(96, 120))
    with pytest.raises(ValueError, match="not written by gift-peft prepare"):
        prepare_gift_i(raw, out)
    assert theirs.read_text() == "mine"


@pytest.mark.parametrize("step", ["remove_files", "_write_record"])
def test_what_a_killed_run_left_is_known_as_ours(step, places, monkeypatch):
    raw, out = places

    class Killed(BaseException):
        pass

    def dies(*given):
        raise Killed

    change_raw(raw, "a")
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(prepare, step, dies)
        prepare_gift_i(raw, out)
    assert json.loads((out / ".prepare/train/a.json").read_text())["digest"] is None
    report = prepare_gift_i(raw, out)
    assert [entry["status"] for entry in report["groups"]] == ["kept", "kept"]
    assert sorted(path.name for path in (out / "train/a").iterdir()) == ["images", "masks"]


def test_a_group_of_a_long_name_is_rejected_alone(places):
    raw, out = places
    for name in ("g" * 250, "\u7d75" * 80):
        (raw / "a").rename(raw / name)
        for _ in range(2):  # the second time from records
            report = prepare_gift_i(raw, out)
            told = {entry["group_id"]: [reason["text"] for reason in entry["reasons"]] for entry in report["groups"]}
            assert told.pop("b") == [] and load_gift_i(out, "train")["group_id"][:] == ["b"]
            ((text,),) = told.values()
            assert f"its name has {len(name.encode())} bytes, at most 210 can be; rename it" in text
        (raw / name).rename(raw / "a")
    (raw / "a").rename(raw / ("g" * 210))
    assert [entry["status"] for entry in prepare_gift_i(raw, out)["groups"]] == ["kept", "kept"]


def test_a_card_edited_by_hand_is_not_replaced(places):
    raw, out = places
    prepare_gift_i(raw, out)  # one that was not edited is written again
    card = out / "README.md"
    card.write_text(card.read_text() + "Cite us.\n")
    with pytest.raises(ValueError, match=r"README\.md: changed since gift-peft prepare wrote it") as error:
        prepare_gift_i(raw, out)
    assert "\n" not in str(error.value) and card.read_text().endswith("Cite us.\n")
    card.unlink()
    prepare_gift_i(raw, out)
    assert "Cite us" not in card.read_text()
    (out / ".prepare/card").unlink()  # as before 0.2.0
    prepare_gift_i(raw, out)
