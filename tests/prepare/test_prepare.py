"""`gift-peft prepare`: what comes out, that it can be stopped and run again, and that it equals what `GiftI` reads."""

import json
import os
import shutil
import signal
import subprocess
import sys

import datasets
import numpy as np
import pytest
from filelock import FileLock
from helpers.photos import capture, entry, motion, moved, scene, statuses, target, with_content, write_capture
from PIL import Image

from gift_peft.cli import main
from gift_peft.dataset.gift_i import dataset_fingerprint, load_gift_i
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.prepare.prepare_verb import parse_arguments
from gift_peft.prepare.settings import PrepareSettings, QualitySettings, RegistrationSettings

SIZE = (160, 200)


pytestmark = pytest.mark.usefixtures("fresh_cache")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """RAW in all its generosity, and OUT; read only."""
    root = tmp_path_factory.mktemp("made")
    raw = root / "raw"
    capture(raw / "plain", 1, count=3, size=SIZE)
    nested = capture(raw / "nested photos", 2, count=2, size=SIZE)
    (nested / "day 1").mkdir()
    for index in range(2):
        (nested / f"{index}.png").rename(nested / "day 1" / f"img_{index + 9}.png")
        mask = np.asarray(Image.open(nested / "masks" / f"{index}.png"))
        Image.fromarray(mask // 255).save(nested / "day 1" / f"img_{index + 9}_mask.png")
    shutil.rmtree(nested / "masks")
    (nested / "group.yaml").write_text("surface: mirror\nnotes: hallway\nstatic_rig: true\n")
    treated = capture(raw / "treated", 3, count=2, size=SIZE, reference=True)
    (treated / "reference.png").rename(treated / "ref_spray.png")
    (raw / "treated" / "reflection.txt").write_text("not a picture")
    rng = np.random.default_rng(0)
    motions = [motion(rng, SIZE, translation=5, degrees=1), motion(rng, SIZE, translation=5, degrees=1)]
    capture(raw / "moved", 4, count=3, size=SIZE, motions=motions)
    report = prepare_gift_i(raw, root / "out")
    return raw, root / "out", report


# ---- what comes out ----


def test_report_statistics_and_card(made):
    raw, out, report = made
    assert report == json.loads((out / "report.json").read_text())
    assert [group["status"] for group in report["groups"]] == ["kept"] * 4, report["groups"]
    assert statuses(report, "plain") == ["identity", "identity", "kept"]
    assert statuses(report, "moved") == ["warped", "warped", "kept"]
    assert statuses(report, "treated") == ["identity", "kept", "identity"]
    assert entry(report, "nested photos")["frames"][0]["registration"]["method"] == "declared static"
    train, validation = report["statistics"]["train"], report["statistics"]["validation"]
    assert train["groups"] == 3 and train["images"] == 8 and train["pairs"] == 7 and train["warped_frames"] == 2
    assert train["group_size"] == {"min": 2, "max": 3, "mean": 8 / 3}
    assert validation["groups"] == 1 and validation["references"] == 1
    card = (out / "README.md").read_text()
    assert "| train | 3 | 8 | 2-3, mean 2.67 | 7 | 0 |" in card and "proposed" not in card
    assert (out / report["raw"]).resolve() == raw.resolve()
    for group in report["groups"]:
        for frame in group["frames"]:
            assert (raw / frame["original"]).is_file()
            assert all((out / frame[key]).is_file() for key in ("prepared", "mask", "valid") if frame[key])
    assert (out / "report.html").stat().st_size > 1000


def test_prepared_groups_equal_the_raw_ones(made):
    raw, out, _ = made
    prepared, plain = datasets.load_dataset(str(out)), datasets.load_dataset("gift_i", data_dir=str(raw))
    assert set(prepared) == set(plain) == {"train", "validation"}
    for split in plain:
        assert prepared[split]["group_id"][:] == plain[split]["group_id"][:]
        for one, other in zip(prepared[split], plain[split], strict=True):
            if one["group_id"] == "moved":
                continue
            assert one["image_names"] == other["image_names"]
            assert one["surface"] in (other["surface"], ["mirror", "transparent"][other["surface"] or 0])
            for key in ("images", "masks"):
                for image, same in zip(one[key], other[key], strict=True):
                    assert image.mode == same.mode and np.array_equal(np.asarray(image), np.asarray(same))
            assert one["valids"] == other["valids"] == []
            assert (one["reference"] is None) == (other["reference"] is None)
            if one["reference"] is not None:
                assert np.array_equal(np.asarray(one["reference"]), np.asarray(other["reference"]))
    rows = [load_gift_i(path, "validation") for path in (out, raw)]
    assert dataset_fingerprint(rows[0]) == dataset_fingerprint(rows[1])
    assert load_gift_i(out, "train")["image_names"][1] == ["day 1/img_9.png", "day 1/img_10.png"]


def test_warped_frames_agree_with_their_target_frame(made):
    _, out, report = made
    row = next(row for row in load_gift_i(out, "train") if row["group_id"] == "moved")
    masks, valids = ([np.asarray(mask) > 0 for mask in row[key]] for key in ("masks", "valids"))
    images = [np.asarray(image).astype(float) for image in row["images"]]
    assert valids[2].all() and not valids[0].all() and not valids[1].all()
    for mask, valid in zip(masks, valids, strict=True):
        assert (mask & masks[2] & valid).sum() / ((mask | masks[2]) & valid).sum() > 0.9
    frames = entry(report, "moved")["frames"]
    for index in (0, 1):
        figures = frames[index]["registration"]
        assert figures["difference_after"] < figures["difference_before"] and figures["inlier_ratio"] >= 0.9
        assert figures["target_displacement"] <= 0.06 * np.hypot(*SIZE) and figures["expected_error"] <= 0.5
        assert "paper_exact" not in figures and "with_additions" not in figures
    outside = ~(masks[0] | masks[2]) & valids[0]
    gain = images[2][outside].std() / images[0][outside].std()
    same = np.abs((images[0] - images[0][outside].mean()) * gain - (images[2] - images[2][outside].mean()))
    assert np.median(same[outside]) < 3


def test_a_moved_reference_is_warped_and_takes_its_border_from_all(tmp_path):
    rng = np.random.default_rng(1)
    picture, mask = scene(11, SIZE), target(11, SIZE)
    treated = picture.copy()
    treated[mask] = 150
    treated, _ = moved(treated, np.zeros_like(mask), np.array([[1, 0, 5.0], [0, 1, 3], [0, 0, 1]]), rng, noise=1)
    frames = [with_content(picture, mask, rng, noise=1) for _ in range(2)]
    write_capture(tmp_path / "raw/g", frames, [mask, mask], treated)
    report = prepare_gift_i(tmp_path / "raw", tmp_path / "out")
    reference = report["groups"][0]["frames"][-1]
    assert reference["status"] == "warped" and reference["warnings"][-1]["code"] == "reference_moved"
    row = load_gift_i(tmp_path / "out", "validation")[0]
    assert all(0.9 < np.asarray(valid).mean() / 255 < 1 for valid in row["valids"])
    inside = np.asarray(row["valids"][0]) > 0
    assert np.abs(np.asarray(row["reference"])[inside & ~mask].mean() - np.asarray(treated).mean()) < 10


def test_a_reference_of_another_place_is_dropped_with_a_warning(tmp_path):
    group = capture(tmp_path / "raw/validation/g", 12, count=2, size=SIZE, reference=True)
    Image.fromarray(scene(99, SIZE)).save(group / "reference.png")
    report = prepare_gift_i(tmp_path / "raw", tmp_path / "out")
    found = report["groups"][0]
    assert found["status"] == "kept" and found["frames"][-1]["status"] == "dropped"
    assert "reference_dropped" in [item["code"] for item in found["warnings"]]
    assert load_gift_i(tmp_path / "out", "validation")[0]["reference"] is None
    (group / "1.png").unlink()  # one observation alone needs its reference
    assert prepare_gift_i(tmp_path / "raw", tmp_path / "out")["groups"][0]["status"] == "rejected"


def test_quality_warnings(tmp_path):
    picture, mask = scene(13, SIZE), target(13, SIZE)
    rng = np.random.default_rng(0)
    frames = [with_content(picture, mask, rng, noise=1) for _ in range(4)]
    frames[0] = np.asarray(Image.fromarray(frames[0]).resize((50, 40)).resize((200, 160)))  # blurred
    frames[1] = frames[3].copy()
    frames[1][::40, ::40] ^= 1  # nearly the last one
    masks = [mask, mask, np.roll(mask, 12, axis=1), mask]
    write_capture(tmp_path / "raw/g", frames, masks)
    (tmp_path / "raw/g/group.yaml").write_text("static_rig: true")
    frames = prepare_gift_i(tmp_path / "raw", tmp_path / "out")["groups"][0]["frames"]
    codes = [{item["code"] for item in frame["warnings"]} for frame in frames]
    assert "blurred" in codes[0] and "near_duplicate" in codes[3] and "mask_disagrees" in codes[2]
    assert all(frame["status"] != "dropped" for frame in frames)
    strict = PrepareSettings(quality=QualitySettings(drop_mask_iou=0.8, drop_sharpness=0.35))
    frames = prepare_gift_i(tmp_path / "raw", tmp_path / "out", strict)["groups"][0]["frames"]
    assert [frame["status"] for frame in frames] == ["dropped", "identity", "dropped", "kept"]
    assert "threshold 0.35" in frames[0]["reasons"][0]["text"]


# ---- again, elsewhere, and stopped in the middle ----


def snapshot(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def copied(made, tmp_path):
    raw, out = shutil.copytree(made[0], tmp_path / "raw"), shutil.copytree(made[1], tmp_path / "out")
    return raw, out


def test_only_what_changed_is_done_again(made, tmp_path):
    raw, out = copied(made, tmp_path)
    before = snapshot(out)
    report = prepare_gift_i(raw, out)
    after = snapshot(out)
    groups = [path for path in before if path.parts[-2] in ("images", "masks", "valids")]
    assert groups and all(before[path] == after[path] for path in groups)
    assert {**report, "raw": ""} == {**made[2], "raw": ""}
    shutil.rmtree(raw / "plain")
    os.utime(raw / "moved/0.png")  # touched, not changed
    Image.fromarray(scene(55, SIZE)).save(raw / "nested photos/day 1/img_9.png")
    (out / entry(report, "treated")["frames"][0]["prepared"]).unlink()  # OUT was tampered with
    report = prepare_gift_i(raw, out)
    assert report["removed"] == ["train/plain"] and not (out / "train/plain").exists()
    assert entry(report, "nested photos")["status"] == "rejected" and not (out / "train/nested photos").exists()
    again = snapshot(out)
    assert all(again[path] == before[path] for path in groups if "moved" in path.parts)
    assert load_gift_i(out, "train")["group_id"][:] == ["moved"]
    assert len(load_gift_i(out, "validation")[0]["images"]) == 2


def test_settings_are_part_of_what_a_group_is_made_from(made, tmp_path):
    raw, out = copied(made, tmp_path)
    report = prepare_gift_i(raw, out, PrepareSettings(static_rig=True))
    assert statuses(report, "moved") != ["warped", "warped", "kept"]
    exact = PrepareSettings(registration=RegistrationSettings(paper_exact=True))
    report = prepare_gift_i(raw, out, exact)
    figures = [
        frame["registration"] for group in report["groups"] for frame in group["frames"] if frame["registration"]
    ]
    verdict = {"accepted", "matches", "inliers", "inlier_ratio", "corner_displacement"}
    measured = [found for found in figures if found["method"] != "declared static"]
    assert measured and all(found["paper_exact"].keys() == verdict for found in measured)
    assert all(found["with_additions"].keys() == {"status", "reasons"} for found in measured)
    assert not any(frame["status"] == "identity" for frame in entry(report, "plain")["frames"])
    assert "--paper-exact" in (out / "README.md").read_text() or report["statistics"]["train"]["groups"] == 0


def test_processes_make_the_same(made, tmp_path):
    raw, out, report = made
    again = prepare_gift_i(raw, tmp_path / "out", num_proc=2)
    assert {**again, "raw": ""} == {**report, "raw": ""}
    for path in out.rglob("*"):
        other = tmp_path / "out" / path.relative_to(out)
        if path.is_file() and path.suffix in (".png", ".parquet"):
            assert path.read_bytes() == other.read_bytes(), path


def test_killed_at_any_group_nothing_is_half_there(made, tmp_path, monkeypatch):
    from gift_peft.prepare import prepare

    raw, _, report = made

    class Killed(BaseException):
        pass

    for step in ("_install", "_write_record", "write_rows"):
        for count in (1, 3):
            place, calls = tmp_path / f"{step}{count}", []
            real = getattr(prepare, step)

            def dies(*arguments, real=real, calls=calls, count=count):
                calls.append(None)
                if len(calls) > count:
                    raise Killed
                return real(*arguments)

            with monkeypatch.context() as patch:
                patch.setattr(prepare, step, dies)
                with pytest.raises(Killed):
                    prepare_gift_i(raw, place)
            for split in ("train", "validation"):  # what the tables name is there, whole
                if (place / split / "metadata.parquet").exists():
                    for row in load_gift_i(place, split):
                        assert row["images"]
            again = prepare_gift_i(raw, place)
            assert {**again, "raw": ""} == {**report, "raw": ""}
            assert not (place / ".prepare/staging").exists()


@pytest.mark.slow
def test_killed_for_real(made, tmp_path):
    raw, _, report = made
    command = [sys.executable, "-m", "gift_peft", "prepare", str(raw), str(tmp_path / "out"), "--num-proc", "2"]
    for wait in (3, 5, 8):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            process.wait(wait)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
    assert subprocess.run(command, check=False).returncode == 0
    again = json.loads((tmp_path / "out/report.json").read_text())
    assert {**again, "raw": ""} == {**report, "raw": ""}


# ---- places and arguments ----


def test_places_that_are_refused(made, tmp_path):
    raw, out, _ = made
    (tmp_path / "full").mkdir()
    (tmp_path / "full/holiday.jpg").write_text("mine")
    for arguments, words in (
        ((raw, raw), "neither inside RAW"),
        ((raw, raw / "out"), "neither inside RAW"),
        ((raw, raw.parent), "neither inside RAW"),
        ((tmp_path / "nowhere", out), "no such folder"),
        ((raw, tmp_path / "full"), "not made by gift-peft prepare"),
        ((raw, tmp_path / "full/holiday.jpg"), "not a folder"),
        ((out, tmp_path / "new"), "prepared folder, not a raw tree"),
        ((tmp_path / "full", tmp_path / "new"), "no group folders"),
    ):
        with pytest.raises((ValueError, OSError)) as error:
            prepare_gift_i(*arguments)
        assert words in str(error.value) and "\n" not in str(error.value)
    assert (tmp_path / "full/holiday.jpg").read_text() == "mine"
    with pytest.raises(ValueError, match="num_proc"):
        prepare_gift_i(raw, tmp_path / "new", num_proc=0)


def test_one_run_at_a_time_in_a_folder(made, tmp_path):
    raw, out = copied(made, tmp_path)
    (out / "report.json").unlink()
    with FileLock(out / ".prepare/lock"):
        before = snapshot(out)
        with pytest.raises(ValueError, match=r"another gift-peft prepare is at work") as error:
            prepare_gift_i(raw, out)
        assert "\n" not in str(error.value)
        assert {**before, out / ".prepare/lock": None} == {**snapshot(out), out / ".prepare/lock": None}
    assert prepare_gift_i(raw, out)["groups"] and (out / "report.json").exists()


def test_arguments(tmp_path):
    config = tmp_path / "prepare.yaml"
    config.write_text("min_inliers: 7\nstatic_rig: true\nwarn_clipped: 0.5\npretty_name: my mirrors\n")
    args = parse_arguments(["RAW", "OUT", "--config", str(config), "--min-inliers", "9", "--num-proc", "3"])
    assert args.settings.registration.min_inliers == 9 and args.settings.quality.warn_clipped == 0.5
    assert args.settings.static_rig and args.num_proc == 3 and args.pretty_name == "my mirrors"
    assert parse_arguments(["RAW", "OUT"]).settings == PrepareSettings()
    assert parse_arguments(["R", "O", "--config", str(config), "--no-static-rig"]).settings.static_rig is False
    assert parse_arguments(["R", "O", "--accept-proposed-masks"]).settings.propose_masks
    assert parse_arguments(["R", "O", "--paper-exact"]).settings.registration.paper_exact
    for text, words in (
        ("min_inlers: 3", "did you mean min_inliers?"),
        ("min_inliers: many", "not a int"),
        ("min_inliers: [1]", "expected one value"),
        ("static_rig: 1", "expected true or false"),
        ("ratio: .nan", "not a float"),
        ("- a", "key: value"),
        ("a: [", "not valid YAML"),
    ):
        config.write_text(text)
        with pytest.raises(ValueError) as error:
            parse_arguments(["RAW", "OUT", "--config", str(config)])
        assert words in str(error.value) and str(config) in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(FileNotFoundError, match="no such file"):
        parse_arguments(["RAW", "OUT", "--config", str(tmp_path / "none.yaml")])
    for wrong in (
        ["RAW"],
        ["RAW", "OUT", "--num-proc", "0"],
        ["RAW", "OUT", "--unknown"],
        ["R", "O", "--ratio", "-1"],
    ):
        with pytest.raises(SystemExit) as ended:
            parse_arguments(wrong)
        assert ended.value.code == 2


def test_command_line(made, tmp_path, capsys):
    raw, out, _ = made
    with pytest.raises(SystemExit) as ended:
        main(["prepare", str(raw), str(shutil.copytree(out, tmp_path / "out"))])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    assert "train: 3 groups, 8 images (2 frames warped, 0 dropped)" in said and "report.html" in said
    with pytest.raises(SystemExit) as ended:
        main(["prepare", str(raw), str(raw / "out")])
    assert ended.value.code == 1 and "gift-peft: error: OUT" in capsys.readouterr().err
