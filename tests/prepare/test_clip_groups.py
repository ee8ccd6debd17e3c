"""`gift-peft prepare` on groups of clips: photos, one mask carried along, references, and what is wrong named."""

import numpy as np
import pytest
from helpers.clips import Making, pushed, views
from helpers.photos import entry, scene
from PIL import Image

from gift_peft.cli import main
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.prepare import clip_groups
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.prepare.settings import PrepareSettings

SIZE = (240, 320)

pytestmark = pytest.mark.usefixtures("fresh_cache")


def clip_of(path, pictures, **options):
    made = Making(SIZE, **options)
    for picture in pictures:
        made.hold(picture)
    return made.write(path)


def draw(path, mask):
    Image.fromarray(mask.astype(np.uint8) * 255).save(path)


def overlap(found, mask):
    return (found & mask).sum() / (found | mask).sum()


@pytest.fixture
def raw(tmp_path):
    """A clip of one pose, one in which the camera is pushed, and one that ends with the treated surface."""
    raw = tmp_path / "raw"
    for seed, name in enumerate(("still", "pushed", "treated")):
        pictures, mask = views(seed + 3, SIZE, 4)
        if name == "pushed":
            pictures[2:] = [pushed(picture, 4) for picture in pictures[2:]]
        if name == "treated":
            pictures[3] = np.where(mask[..., None], 150, pictures[0])
        clip_of(raw / name / "clip.mp4", pictures, seed=seed)
        draw(raw / name / "mask.png", mask)
    (raw / "treated/group.yaml").write_text("surface: mirror\nreference: 00:03.4\n")
    return raw


def test_clips_become_groups_with_the_mask_on_every_frame(raw, tmp_path):
    report = prepare_gift_i(raw, tmp_path / "out")
    found = {group["group_id"]: group for group in report["groups"]}
    assert {name: group["status"] for name, group in found.items()} == dict.fromkeys(
        ("still", "pushed", "pushed__2", "treated"), "kept"
    ), report["groups"]
    assert found["treated"]["split"] == "validation" and found["treated"]["surface"] == "mirror"
    assert "frames chosen from clip.mp4" in found["still"]["warnings"][0]["text"]
    masks = {name: views(seed + 3, SIZE, 1)[1] for seed, name in enumerate(("still", "pushed", "treated"))}
    masks["pushed__2"] = pushed(masks["pushed"].astype(np.uint8) * 255, 4) > 127
    rows = [*load_gift_i(tmp_path / "out", "train"), *load_gift_i(tmp_path / "out", "validation")]
    counts = {row["group_id"]: len(row["images"]) for row in rows}
    assert counts == {"still": 4, "pushed": 2, "pushed__2": 2, "treated": 3}
    for row in rows:
        for mask in row["masks"]:
            assert overlap(np.asarray(mask) > 0, masks[row["group_id"]]) > 0.95
    reference = np.asarray(rows[-1]["reference"]).astype(float)
    assert abs(reference[masks["treated"]].mean() - 150) < 5


def test_a_second_run_reads_no_clip(raw, tmp_path, monkeypatch):
    first = prepare_gift_i(raw, tmp_path / "out")

    def no_work(*args, **kwargs):
        raise AssertionError("a clip was read again")

    monkeypatch.setattr(clip_groups, "choose_frames", no_work)
    assert prepare_gift_i(raw, tmp_path / "out")["groups"] == first["groups"]
    (raw / "still/clip.mp4").unlink()
    (raw / "still/mask.png").unlink()
    (raw / "still").rmdir()
    assert "still" not in {group["group_id"] for group in prepare_gift_i(raw, tmp_path / "out")["groups"]}
    assert not (tmp_path / "out/.prepare/clips/train/still").exists()


def test_frames_are_chosen_again_when_a_mask_was_drawn(tmp_path):
    """The usual order: a first run tells that the mask is missing."""
    pictures, mask = views(3, SIZE, 3)
    clip_of(tmp_path / "raw" / "hall" / "clip.mp4", pictures)
    first = prepare_gift_i(tmp_path / "raw", tmp_path / "out")
    assert first["groups"][0]["reasons"][0]["code"] == "masks_missing"
    draw(tmp_path / "raw" / "hall" / "mask.png", mask)
    assert prepare_gift_i(tmp_path / "raw", tmp_path / "out")["groups"][0]["status"] == "kept"


def test_the_original_of_a_frame_is_found_from_the_report(raw, tmp_path):
    report = prepare_gift_i(raw, tmp_path / "out")
    for frame in entry(report, "still")["frames"]:
        assert (tmp_path / "out" / report["raw"] / frame["original"]).is_file()
    assert entry(report, "still")["folder"] == "still"


def test_what_is_wrong_with_a_clip_rejects_its_group_alone(raw, tmp_path, capsys):
    (raw / "still/clip.mp4").write_bytes(b"no clip")
    draw(raw / "treated/mask.png", np.ones((10, 10), bool))
    with pytest.raises(SystemExit) as leaving:
        main(["prepare", str(raw), str(tmp_path / "out")])
    said = capsys.readouterr().err
    assert leaving.value.code == 3
    assert "rejected: train/still: still/clip.mp4: cannot be opened as a video" in said
    assert "rejected: validation/treated: treated/mask.png" in said
    assert len(load_gift_i(tmp_path / "out", "train")) == 2


def test_a_mask_that_moves_out_of_the_picture_is_named(tmp_path):
    raw = tmp_path / "raw"
    mask = np.zeros(SIZE, bool)
    mask[40:90, -14:] = True
    pictures = [np.where(mask[..., None], scene(3000 + index, SIZE), scene(3, SIZE)) for index in range(4)]
    pictures[2:] = [pushed(picture, 20) for picture in pictures[2:]]
    clip_of(raw / "hall/clip.mp4", pictures)
    draw(raw / "hall/mask.png", mask)
    report = prepare_gift_i(raw, tmp_path / "out", PrepareSettings())
    second = entry(report, "hall__2")
    assert second["status"] == "rejected"
    assert "the mask moves out of the picture, so mask.png does not hold; cut the clip" in second["reasons"][0]["text"]


def test_a_plan_names_clips_and_reads_none(raw, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(clip_groups, "choose_frames", None)
    with pytest.raises(SystemExit) as leaving:
        main(["prepare", str(raw), str(tmp_path / "out"), "--dry-run", "--max-frames", "5"])
    said = capsys.readouterr().out
    assert leaving.value.code == 0 and not (tmp_path / "out").exists()
    assert "at most 5 frames a pose would be chosen: train/pushed, train/still, validation/treated" in said
