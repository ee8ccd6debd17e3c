"""`gift-peft predict` with a sensor, taped distances, cameras and clips, as typed: files, lines and exit codes."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.demo_folder import write_demo
from PIL import Image

from gift_peft.cli import main
from gift_peft.deploy.look_ahead import predict_ahead
from gift_peft.deploy.sensor import fill_sensor_depth
from gift_peft.deploy.video import predict_video
from gift_peft.models.loading import DepthModel

pytestmark = [
    pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning"),
    pytest.mark.filterwarnings("ignore:the base is the local folder"),
]
PHOTO = 60, 80


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return write_demo(tmp_path_factory.mktemp("demo"))


@pytest.fixture(scope="module")
def model(demo):
    return DepthModel.from_pretrained(demo / "base", demo / "adapter", device="cpu")


@pytest.fixture
def work(demo, model, tmp_path, monkeypatch):
    """Two photos, a sensor's depth of them (glass is 0.8 m farther), and masks; the model is right."""
    random = np.random.default_rng(0)
    for folder in ("rgb", "depth", "masks"):
        (tmp_path / folder).mkdir()
    for index in range(2):
        coarse = random.integers(0, 255, (6, 8, 3), dtype=np.uint8)
        photo = Image.fromarray(coarse).resize(PHOTO[::-1], Image.Resampling.BICUBIC)
        photo.save(tmp_path / "rgb" / f"{index}.png")
        inverse = model.depth_at(tmp_path / "rgb" / f"{index}.png")
        low, high = inverse.min(), inverse.max()
        depth = 1 / (0.3 + 0.5 * (inverse - low) / (high - low))
        mask = np.zeros(PHOTO, bool)
        mask[15:40, 20:60] = True
        np.save(tmp_path / f"true{index}.npy", depth)
        sensor = np.where(mask, depth + 0.8, depth)
        sensor[:5] = 0
        Image.fromarray(np.rint(1000 * sensor).astype(np.uint16)).save(tmp_path / "depth" / f"{index}.png")
        Image.fromarray(mask.astype(np.uint8) * 255).save(tmp_path / "masks" / f"{index}.png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(demo, capsys, *words):
    """(exit code, stdout, stderr)"""
    with pytest.raises(SystemExit) as end:
        main(["predict", *map(str, words), f"--base={demo / 'base'}", f"--adapter={demo / 'adapter'}", "--out=out"])
    return end.value.code or 0, *capsys.readouterr()


def test_sensor_depth_gives_metric_depth_confidence_and_what_was_replaced(demo, work, capsys):
    code, out, err = run(demo, capsys, "rgb", "--sensor-depth=depth", "--sensor_mask", "masks", "--png16")
    assert code == 0, err
    assert "Depth maps written to out: 2" in out and "a second" in out and "Metric depth in metres" in out
    for index in range(2):
        true, metric = np.load(f"true{index}.npy"), np.load(f"out/{index}_metric.npy")
        assert metric.dtype == np.float32 and metric.shape == PHOTO
        np.testing.assert_allclose(metric, true, rtol=0.01)
        picture = Image.open(f"out/{index}_metric.png")
        assert picture.text["Unit"] == "mm"
        np.testing.assert_allclose(np.asarray(picture), 1000 * metric, atol=0.51)
        replaced = np.asarray(Image.open(f"out/{index}_replaced.png")) > 0
        mask = np.asarray(Image.open(f"masks/{index}.png")) > 0
        mask[:5] = True
        np.testing.assert_array_equal(replaced, mask)
        confidence = np.asarray(Image.open(f"out/{index}_confidence.png"))
        assert (confidence[~replaced] == 255).all() and confidence[replaced].min() < 255
        # the 16-bit picture of the prediction itself says how to read it
        deep = Image.open(f"out/{index}_16bit.png")
        row = json.loads((work / "out" / "metric.json").read_text())[index]
        native = np.load(f"out/{index}.npy")
        scale, offset = row["png16"]["scale"], row["png16"]["offset"]
        np.testing.assert_allclose(np.asarray(deep) * scale + offset, native, atol=0.51 * scale)
        assert deep.text["Unit"].startswith("native units of inverse_depth = ")
        assert row["sensor"] == f"{index}.png" and row["relative_error"] < 0.01


def test_sizes_may_differ_and_without_masks_the_fit_finds_the_glass(demo, work, capsys):
    for index in range(2):
        depth = Image.open(f"depth/{index}.png")
        np.save(f"depth/{index}.npy", np.asarray(depth.resize((160, 120), Image.Resampling.NEAREST)) / 1000)
        (work / "depth" / f"{index}.png").unlink()
    code, _, err = run(demo, capsys, "rgb", "--sensor-depth", "depth")
    assert code == 0, err
    true, metric = np.load("true0.npy"), np.load("out/0_metric.npy")
    assert np.median(np.abs(metric - true)[18:37, 24:56]) < 0.1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d[:, :70], ["60x70", "the photo 60x80", "another camera or crop"]),
        (lambda d: np.zeros_like(d), ["no depth at all"]),
        (lambda d: np.maximum(d // 1000, 1), ["taken as mm", "--sensor-unit m"]),
        # Which of two reasons is told, "does not grow" or "not registered", depends on what the adapter predicts.
        (lambda d: np.where(d > 0, d.max() + 300 - d, 0), ["depth/0.png: "]),
    ],
    ids=["another size", "all zero", "metres", "another scene"],
)
def test_a_wrong_sensor_is_one_line_and_the_other_photos_are_done(change, words, demo, work, capsys):
    values = np.asarray(Image.open("depth/0.png"))
    Image.fromarray(np.ascontiguousarray(change(values))).save("depth/0.png")
    code, out, err = run(demo, capsys, "rgb", "--sensor-depth", "depth", "--sensor-mask", "masks")
    assert code == 1 and "written to out: 1" in out
    (line,) = [line for line in err.splitlines() if line.startswith("gift-peft: error:")]
    assert all(word in line for word in words), line
    assert not list((work / "out").glob("0_metric*")) and (work / "out" / "1_metric.npy").exists()


def test_depth_that_is_moved_is_told(demo, work, capsys):
    values = np.asarray(Image.open("depth/0.png"))
    Image.fromarray(np.roll(values, 6, axis=1)).save("depth/0.png")
    code, _, err = run(demo, capsys, "rgb/0.png", "--sensor-depth", "depth/0.png")
    assert code == 1 and "not registered to the photo's camera" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["rgb", "--sensor-depth=nowhere"], "sensor depth nowhere: no such file or folder"),
        (["rgb", "--calibrate=nowhere.csv"], "nowhere.csv: no such file"),
        (["rgb", "--pointcloud=ply", "--camera=nowhere.yaml"], "camera nowhere.yaml: no such file"),
        (["--video=nowhere.mp4"], "nowhere.mp4: no such clip"),
        (["--video=rgb/0.png.txt"], "not a clip that can be read"),
        (["--video=rgb/0.png"], "rgb/0.png: a picture, not a clip; leave --video out"),
        (["--video=77"], "camera 77: it cannot be opened"),
    ],
)
def test_what_is_not_there_is_one_line_and_leaves_nothing(words, message, demo, work, capsys):
    pytest.importorskip("trimesh", reason="the extra `pointcloud` is not installed")
    (work / "rgb" / "0.png.txt").write_text("no clip")
    code, _, err = run(demo, capsys, *words)
    assert code == 1 and message in err
    assert not (work / "out").exists() or not any((work / "out").iterdir())


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["rgb", "--video=a.mp4"],
        ["rgb", "--sensor-mask=masks"],
        ["rgb", "--sensor-depth=depth", "--calibrate=p.csv"],
        ["rgb", "--sensor-depth=depth", "--sensor-unit=inch"],
        ["rgb", "--fov=200"],
        ["rgb", "--fov=60", "--camera=c.yaml"],
        ["rgb", "--frames=3"],
        ["--video=a.mp4", "--pointcloud=ply"],
    ],
)
def test_wrong_usage_is_2(words, demo, work, capsys):
    assert run(demo, capsys, *words)[0] == 2


def test_taped_distances_and_a_point_cloud(demo, work, capsys):
    trimesh = pytest.importorskip("trimesh", reason="the extra `pointcloud` is not installed")
    true = np.load("true0.npy")
    points = [f"{x},{y},{true[y, x]}" for x, y in ((5, 8), (70, 50), (30, 30))]
    (work / "p.csv").write_text("\n".join(["x,y,depth_m", *points]))
    code, out, err = run(demo, capsys, "rgb/0.png", "--calibrate=p.csv", "--pointcloud=ply", "--fov=60")
    assert code == 0, err
    assert "largest error at a taped point 0.00" in out
    np.testing.assert_allclose(np.load("out/0_metric.npy"), true, rtol=1e-3)
    cloud = trimesh.load("out/0.ply")
    assert 0.5 * true.size < len(cloud.vertices) <= true.size
    assert cloud.vertices[:, 2].min() == pytest.approx(true.min(), rel=0.05)
    code, _, err = run(demo, capsys, "rgb/0.png", "--pointcloud=ply")
    assert code == 1 and "no focal length in its EXIF; give --fov DEGREES or --camera camera.yaml" in err


def test_pictures_ahead_are_those_of_depth_at_and_errors_keep_their_place(model, work):
    shutil.copy("rgb/1.png", "rgb/3.png")
    (work / "rgb" / "2.png").write_bytes(b"no picture")
    files = [work / "rgb" / f"{index}.png" for index in range(4)]
    for batch_size in (1, 3):
        results = list(predict_ahead(model, files, base_too=True, batch_size=batch_size))
        assert isinstance(results[2], ValueError) and "2.png" in str(results[2])
        for index in (0, 1, 3):
            for name, base in (("own", False), ("base", True)):
                expected = model.depth_at(files[index], base=base)
                np.testing.assert_allclose(results[index][name], expected, rtol=1e-4)
                assert batch_size > 1 or np.array_equal(results[index][name], expected)


def test_metric_files_of_the_verb_are_those_of_the_function(demo, work, model, capsys):
    run(demo, capsys, "rgb/0.png", "--sensor-depth", "depth/0.png", "--sensor-mask", "masks/0.png")
    sensor = np.asarray(Image.open("depth/0.png")) / 1000
    mask = np.asarray(Image.open("masks/0.png")) > 0
    filled = fill_sensor_depth(model.depth_at("rgb/0.png"), sensor, mask, "inverse_depth")
    np.testing.assert_array_equal(np.load("out/0_metric.npy"), filled.depth)


def test_files_of_others_are_kept_and_own_ones_replaced(demo, work, capsys):
    pytest.importorskip("trimesh", reason="the extra `pointcloud` is not installed")
    words = ["rgb/0.png", "--sensor-depth=depth/0.png", "--sensor-mask=masks/0.png", "--pointcloud=ply", "--fov=60"]
    (work / "out").mkdir()
    for name in ("0_metric.png", "0_replaced.png", "0.ply", "metric.json"):
        (work / "out" / name).write_text("mine")
        code, _, err = run(demo, capsys, *words)
        assert code == 1 and f"{name} was not written by gift-peft predict and is kept" in err
        assert [path.name for path in (work / "out").iterdir()] == [name]
        (work / "out" / name).unlink()
    for _ in range(2):
        assert run(demo, capsys, *words)[0] == 0


# ---- clips ----


def write_clip(path, frames, size=(96, 64)):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 12.0, size)
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()


@pytest.mark.parametrize("still", [True, False])
def test_a_clip_shows_photo_base_and_adapted_and_its_flicker(still, demo, work, capsys):
    random = np.random.default_rng(0)
    first = cv2.resize(random.integers(0, 255, (8, 12, 3), dtype=np.uint8), (96, 64))
    frames = [first.copy() for _ in range(5)]
    if not still:  # what is seen in the target changes
        for frame in frames:
            frame[20:40, 30:70] = cv2.resize(random.integers(0, 255, (5, 8, 3), dtype=np.uint8), (40, 20))
    write_clip("in.mp4", frames)
    mask = np.zeros((64, 96), np.uint8)
    mask[20:40, 30:70] = 255
    Image.fromarray(mask).save("mask.png")
    code, out, err = run(demo, capsys, "--video=in.mp4", "--sensor-mask=mask.png", "--batch-size=2")
    assert code == 0, err
    assert "5 frames" in out and "a second" in out and "Flicker inside the target, adapted" in out
    facts = json.loads((work / "out" / "in_depth.json").read_text())
    assert facts["frames"] == 5 and facts["frames_per_second"] > 0
    flicker = facts["flicker_percent"]
    assert flicker.keys() == {"base", "adapted"}
    assert flicker["adapted"] < 1 if still else flicker["adapted"] > 1
    capture = cv2.VideoCapture("out/in_depth.mp4")
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 5 and capture.get(cv2.CAP_PROP_FPS) == 12
    there, frame = capture.read()
    assert there and frame.shape == (64, 3 * 96, 3)
    assert np.abs(frame[:, :96].astype(int) - frames[0]).mean() < 12
    assert sorted(path.name for path in (work / "out").iterdir()) == ["in_depth.json", "in_depth.mp4"]


def test_a_clip_of_others_is_kept(demo, work, capsys):
    write_clip("in.mp4", [np.zeros((64, 96, 3), np.uint8)] * 2)
    (work / "out").mkdir()
    (work / "out" / "in_depth.mp4").write_text("mine")
    code, _, err = run(demo, capsys, "--video=in.mp4")
    assert code == 1 and "in_depth.mp4 was not written by gift-peft predict and is kept" in err
    assert (work / "out" / "in_depth.mp4").read_text() == "mine"


def test_a_frame_without_depth_is_named_by_its_own_number(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_clip("in.mp4", [np.zeros((64, 96, 3), np.uint8)] * 5)

    class Model:
        adapted, kind = False, "depth"

        def inputs(self, pictures):
            return np.zeros((len(pictures), 1))

        def depths_of(self, pixels, sizes, names, base):
            if names[-1].endswith("3"):
                raise ValueError(f"{names[-1]}: the prediction has NaN or infinite values")
            return [np.arange(np.prod(size), dtype=np.float32).reshape(size) for size in sizes]

    with pytest.raises(ValueError, match=r"^in\.mp4, frame 3: "):
        predict_video("in.mp4", Model(), "out", batch_size=2, progress=False)
    assert not list(Path("out").iterdir())


def test_a_mask_of_another_shape_leaves_no_clip(demo, work, capsys):
    write_clip("in.mp4", [np.zeros((64, 96, 3), np.uint8)] * 2)
    Image.fromarray(np.zeros((64, 64), np.uint8)).save("mask.png")
    code, _, err = run(demo, capsys, "--video=in.mp4", "--sensor-mask=mask.png")
    assert code == 1 and "mask.png: the mask is 64x64" in err
    assert list((work / "out").iterdir()) == []
