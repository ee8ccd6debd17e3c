"""The demo on a three-group stand-in, and what the embedded assets promise."""

import json
import os
import shlex
import signal
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tiny import write_base
from PIL import Image
from transformers import AutoModelForDepthEstimation

from gift_peft import cli, load_gift_i
from gift_peft.dataset.export import export_parquet
from gift_peft.dataset.writer import write_gift_i
from gift_peft.demo import run
from gift_peft.demo.side_by_side import KINDS as KIND_LABELS
from gift_peft.training.progress import Progress

KINDS = ("mirror", "pane", "solid")


def groups(split):
    rng = np.random.default_rng(3)
    for kind in KINDS:
        mask = np.zeros((60, 75), bool)
        mask[20:45, 20:50] = True
        pictures = [Image.fromarray(rng.integers(0, 255, (60, 75, 3), dtype=np.uint8)) for _ in range(3)]
        yield {
            "split": split,
            "group_id": f"{kind}_000",
            "surface": "mirror" if kind == "mirror" else "transparent",
            "images": pictures[:2],
            "masks": [mask, mask],
            "depths": [rng.integers(500, 5000, (60, 75)).astype(np.uint16)] * 2 if split == "validation" else [],
            "reference": pictures[2] if split == "validation" else None,
        }


@pytest.fixture
def embedded(tmp_path, monkeypatch):
    root = tmp_path / "package"
    write_base(root / "base")
    for split in ("train", "validation"):
        write_gift_i(groups(split), tmp_path / "loose", license="apache-2.0")
    export_parquet(tmp_path / "loose", root / "gift-i")
    monkeypatch.setattr(run, "files", lambda package: root)
    return root


def test_demo_leaves_everything_it_promises(embedded, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    reports = run.run_demo("demo", extra=["--num_train_epochs=1"])
    assert {target: list(pair) for target, pair in reports.items()} == {
        target: ["proxy", "depth"] for target in ("consensus", "surface")
    }
    printed = capsys.readouterr().out
    assert "Training 2 of 2: surface targets" in printed and "ToM RMSE, true depth" in printed
    assert "demo/before_after.png" in printed and "demo/surface/adapter" in printed
    assert "\x1b[" not in printed  # not a terminal
    assert max(map(len, printed.split("ToM RMSE, true depth")[1].splitlines())) <= 80
    with Image.open("demo/before_after.png") as picture:
        assert picture.width > 2500  # five columns
    text = Path("demo/report.md").read_text()
    assert all(label in text for label in KIND_LABELS.values()) and "consensus" in text.lower()
    assert "## Paper's objective, in full" in text and "## Surface targets, in full" in text
    check_side_by_side(text, reports)
    left = {path.name for path in Path("demo/surface").iterdir()}
    shared = {"adapter", "adapter-last", "config.yaml", "metrics.jsonl", "evaluation-proxy", "evaluation-depth"}
    assert shared <= left and shared <= set(os.listdir("demo")) and "base" not in left
    assert "target: surface" in Path("demo/surface/config.yaml").read_text()
    assert json.loads(Path("demo/surface/adapter/gift.json").read_text())["arguments"]["target"] == "surface"
    assert sorted(os.listdir("demo/gift-i")) == ["README.md", "data", "proxies"]  # what `export` writes, and proxies
    assert "(validation.html)" in text
    page = Path("demo/validation.html").read_text()
    assert page.count("<img ") == 9 and page.count("treated reference</figcaption>") == 3
    assert all(f"<h2>{kind}_000, " in page for kind in KINDS) and "http" not in page and "<script" not in page
    # The adapter names its base by the path demo/base.
    assert json.loads(Path("demo/adapter/adapter_config.json").read_text())["base_model_name_or_path"] == "demo/base"
    model = AutoModelForDepthEstimation.from_pretrained("demo/adapter").eval()
    assert torch.isfinite(model(torch.zeros(1, 3, 112, 140)).predicted_depth).all()

    with pytest.raises(ValueError, match=r"demo already holds a run; --resume_from_checkpoint latest"):
        run.run_demo("demo")
    assert "channels_last: true" in Path("demo/config.yaml").read_text()
    run.run_demo("demo", overwrite_output_dir=True, seed=1, extra=["--max_steps=1", "--head=lora"])
    assert len(Path("demo/metrics.jsonl").read_text().splitlines()) == 2
    assert "1 updates" in Path("demo/report.md").read_text() and "1 epochs" in text


def check_side_by_side(text, reports):
    """The table's numbers are those of the reports, computed here from their rows."""
    lines = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in text.splitlines() if line.startswith("| ")}
    for reference, against in (("depth", "true depth"), ("proxy", "the proxy")):
        for region, name in (("tom", "ToM"), ("other", "Other")):
            cells = lines[f"{name} RMSE, {against} ↓"]
            rows = reports["consensus"][reference].rows
            assert float(cells[0]) == pytest.approx(np.mean([row["base"][region]["rmse"] for row in rows]), rel=1e-3)
            for cell, target in zip(cells[1:], ("consensus", "surface"), strict=True):
                rows = reports[target][reference].rows
                expected = np.mean([row["adapted"][region]["rmse"] for row in rows])
                assert float(cell.strip(" *").split()[0]) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("target", ["consensus", "surface"])
def test_one_target_alone_is_the_demo(embedded, tmp_path, monkeypatch, capsys, target):
    monkeypatch.chdir(tmp_path)
    assert list(run.run_demo("demo", target=target, extra=["--max_steps=1"])) == [target]
    assert f"target: {target}" in Path("demo/config.yaml").read_text()
    assert not Path("demo/surface").exists() and Path("demo/adapter").is_dir()
    assert "Training 1" not in capsys.readouterr().out
    with Image.open("demo/before_after.png") as picture:
        assert 2000 < picture.width < 2500  # four columns


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("theirs", "said"),
    [
        ("base/model.safetensors", "base holds files"),
        ("gift-i/train/hall/0.png", "gift-i holds files"),
        ("report.md", "has report.md"),
        ("evaluation-depth/notes.txt", "has evaluation-depth"),
        ("config.yaml", "has config.yaml"),
    ],
)
@pytest.mark.parametrize("overwrite", [False, True])
def test_the_demo_keeps_what_no_demo_wrote(theirs, said, overwrite, embedded, tmp_path):
    out = tmp_path / "demo"
    (out / theirs).parent.mkdir(parents=True)
    (out / theirs).write_text("mine: 1\n")
    with pytest.raises(ValueError, match=said):
        run.run_demo(out, overwrite_output_dir=overwrite)
    assert (out / theirs).read_text() == "mine: 1\n"


def test_a_demo_again_replaces_its_own_and_nothing_added(embedded, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run._copy_embedded("base", Path("demo/base"), earlier=False)  # as a demo that was killed here
    run._copy_embedded("base", Path("demo/base"), earlier=False)
    (tmp_path / "demo/base/notes.txt").write_text("mine")
    before = contents(tmp_path / "demo/base")
    run._copy_embedded("base", Path("demo/base"), earlier=True)
    assert contents(tmp_path / "demo/base") == before  # the same base: nothing to do
    write_base(embedded / "base", seed=5)  # that of another version
    with pytest.raises(ValueError, match=r"base holds files .*notes\.txt"):
        run._copy_embedded("base", Path("demo/base"), earlier=True)
    (tmp_path / "demo/base/notes.txt").unlink()
    run._copy_embedded("base", Path("demo/base"), earlier=True)
    assert contents(tmp_path / "demo/base") == contents(embedded / "base") != before


def test_a_stopped_demo_says_how_to_go_on_up_to_table_and_picture(embedded, tmp_path, monkeypatch, capsys):
    out, step = tmp_path / "my demo", Progress.step

    def step_and_stop(self, *losses):
        step(self, *losses)
        os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Progress, "step", step_and_stop)
        run.run_demo(out, seed=3, extra=["--num_train_epochs=2"])
    told = capsys.readouterr().out.splitlines()[-1]
    words = shlex.split(told)
    assert words[:2] == ["gift-peft", "demo"] and "--num_train_epochs=2" in words and not (out / "report.md").exists()
    with pytest.raises(SystemExit) as left:
        cli.main(words[1:])
    assert left.value.code == 0 and "seed 3" in (out / "report.md").read_text()
    assert (out / "before_after.png").is_file() and (out / "validation.html").is_file()


@pytest.mark.parametrize("argument", ["--output_dir=x", "--dataset_name=mine", "--model_name_or_path=x/base"])
def test_what_the_demo_brings_itself_is_not_replaced(embedded, tmp_path, argument):
    name = argument[2:].split("=")[0]
    with pytest.raises(ValueError, match=f"{name}: the demo has its own"):
        run.run_demo(tmp_path / "demo", extra=[argument])
    assert not (tmp_path / "demo").exists()


def test_a_package_without_its_assets_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "files", lambda package: tmp_path / "nothing")
    with pytest.raises(FileNotFoundError, match="lacks gift_peft/demo/base"):
        run.run_demo(tmp_path / "demo")


def test_embedded_assets_keep_their_promises():
    root = Path(str(files("gift_peft.demo")))
    paths = [path for name in ("base", "gift-i") for path in (root / name).rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in paths) < 16e6
    train, validation = (load_gift_i(root / "gift-i", split) for split in ("train", "validation"))
    kinds = [row.split("_")[0] for row in train["group_id"]]
    assert [kinds.count(kind) for kind in KINDS] == [106, 106, 106]
    kinds = [row.split("_")[0] for row in validation["group_id"]]
    assert [kinds.count(kind) for kind in KINDS] == [8, 8, 8]
    assert not any(train["depths"]) and not any(train["reference"])  # the demo cannot look at them
    for row in validation:
        assert len(row["depths"]) == len(row["images"]) == len(row["masks"]) and row["reference"] is not None
        depth = np.asarray(row["depths"])
        assert 250 < depth.min() < depth.max() < 30_000
    model = AutoModelForDepthEstimation.from_pretrained(root / "base")
    assert model.config.depth_estimation_type == "relative"
    assert {p.dtype for p in model.parameters()} == {torch.float32}
