"""The benchmark's epoch is GIFT-I's, its models are the released ones, and it and the profile run."""

import json
import math
import os
import subprocess
import sys
import weakref
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.group_tools import group, toy
from helpers.runs import arguments

from gift_peft.training import train
from gift_peft.training.profiling import PHASES, count_flops, matmul_rate, peak_memory

EXAMPLES = Path(__file__).parents[2] / "examples" / "tools"


@pytest.fixture
def modules(monkeypatch):
    """The benchmark's parts, imported as the script does."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    from benchmark import epoch, models

    return epoch, models


def test_group_sizes_have_the_papers_sums(modules):
    sizes = [n for n, count in modules[0].GROUP_SIZES.items() for _ in range(count)]
    assert (len(sizes), min(sizes), max(sizes)) == (353, 2, 55)
    assert sum(sizes) == 3268
    assert sum(math.comb(n, 2) for n in sizes) == 20339


@pytest.mark.parametrize("name", ["tiny", "12-block", "depth-anything-v2-large"])
def test_strata_cover_the_epoch(modules, name):
    epoch, models = modules
    strata = epoch.make_strata(models.CONFIGS[name].strata)
    assert sum(s.groups for s in strata) == 353
    assert sum(s.images for s in strata) == 3268
    assert sum(s.pairs for s in strata) == 20339
    assert len({s.sample for s in strata}) == len(strata)


def test_an_epoch_is_scaled_by_images_or_by_pairs(modules):
    epoch, _ = modules
    stratum = epoch.Stratum(groups=10, images=50, pairs=100, sample=5)
    group = epoch.Timing(2.0, {"load": 0.5, "replay": 1.0}, forwards=10, updates=1)
    whole = group.in_epoch(stratum, "b")
    assert (whole.seconds, whole.phases, whole.forwards, whole.updates) == (20, {"load": 5, "replay": 10}, 100, 10)
    pairs = epoch.Timing(2.5, {"load": 0.5, "replay": 1.0}, forwards=8, updates=4).in_epoch(stratum, "a")
    assert (pairs.seconds, pairs.phases, pairs.forwards) == (10 * 0.5 + 100 * 0.5, {"load": 5, "replay": 25}, 200)
    both = whole + pairs
    assert (both.seconds, both.updates, both.phases["load"]) == (75, 110, 10)


@pytest.mark.parametrize(
    ("name", "millions"),
    [("12-block", 24.8), ("depth-anything-v2-large", 335.3), ("metric3d-v2-large", 411.9), ("vggt-1b", 941.8)],
)
def test_models_have_the_released_sizes(modules, name, millions):
    with torch.device("meta"):
        model = modules[1].CONFIGS[name].build()
    assert sum(p.numel() for p in model.parameters()) / 1e6 == pytest.approx(millions, abs=0.05)


def test_options_are_timed_with_one_model_at_a_time(modules, monkeypatch):
    """Beside the benchmark's own; a 24 GB card could not hold five of VGGT."""
    import benchmark_group_step as script

    alive, made = weakref.WeakSet(), []

    def make(base):
        assert not alive
        made.append(None)
        model = toy()
        alive.add(model)
        return model

    monkeypatch.setattr(script, "get_gift_model", make)
    monkeypatch.setattr(script, "load_base", lambda base: (None, None))
    monkeypatch.setattr(script, "checkpoint_blocks", lambda model: None)
    monkeypatch.setattr(script, "channels_last_head", lambda model, wanted: nullcontext())
    pixels, mask, target, _ = group(3, torch.float32)
    some = SimpleNamespace(pixel_values=pixels, mask=mask, target=target)
    bench = SimpleNamespace(base="", device=torch.device("cpu"), accelerator=None, index={3: 0}, groups=[some])
    seconds = script.measure_options(bench, 3, 1, compiled=False)
    assert len(made) == len(seconds) == 4 and all(value > 0 for value in seconds.values())


def test_flops_of_a_linear_layer():
    layer = torch.nn.Linear(6, 4, bias=False)

    class Model(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = layer

        def forward(self, pixel_values):
            return self.layer(pixel_values.flatten(1))

    layer.weight.grad = torch.ones_like(layer.weight)
    flops = count_flops(Model(), torch.rand(5, 1, 2, 3))
    assert flops == (2 * 6 * 4, 2 * 6 * 4)  # the input needs no gradient
    assert torch.equal(layer.weight.grad, torch.ones_like(layer.weight))


def test_rates_and_memory_are_numbers():
    assert matmul_rate(torch.device("cpu"), torch.float32) > 1e8
    assert peak_memory(torch.device("cpu")) > 2**26


def test_profile_prints_where_the_time_goes_and_writes_nothing(base_dir, raw_tree, tmp_path, capsys):
    result = train(arguments(base_dir, raw_tree, tmp_path / "out", profile=2))
    text = capsys.readouterr().out
    assert result.step == 0 and not list((tmp_path / "out").iterdir())
    assert "2 updates, 5 images, 5 image forwards (1.00 per image)" in text
    assert all(f"{phase} " in text for phase in PHASES) and "TFLOP/s" in text and "retain auto: up to" in text


def test_a_section_of_the_page_is_replaced_alone(modules, tmp_path):
    from benchmark.report import replace_section

    page = tmp_path / "benchmark.md"
    replace_section(page, "One", "1\n\n## Deeper\n\n2\n")
    replace_section(page, "Two", "3")
    replace_section(page, "One", "4")
    assert page.read_text() == "# One\n\n4\n\n# Two\n\n3\n"


@pytest.mark.slow
def test_the_benchmark_of_exports_runs(tmp_path):
    command = [sys.executable, str(EXAMPLES / "benchmark_deploy.py"), "--repeats", "1", "--exports", "small"]
    command += ["--out", str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert result.returncode == 0, result.stderr
    text = (tmp_path / "benchmark.md").read_text()
    for way in ("torch", "onnxruntime", "OpenVINO (float32)", "onnxruntime, int8"):
        assert f"\n| {way} |" in text
    assert "\n| V2-Small |" in text


@pytest.mark.slow
def test_the_benchmark_runs(tmp_path):
    command = [sys.executable, str(EXAMPLES / "benchmark_group_step.py"), "--models", "tiny", "vggt-1b"]
    command += ["--repeats", "1", "--pairs", "1", "--option_size", "2", "--out", str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert result.returncode == 0, result.stderr
    tiny = json.loads((tmp_path / "benchmark.json").read_text())["models"]["tiny"]
    forwards = {method: row["image_forwards"] for method, row in tiny["methods"].items()}
    assert forwards == {"a": 40678, "b": 6536, "c": 3268, "d": 3268}
    updates = {method: row["updates"] for method, row in tiny["methods"].items()}
    assert updates == {"a": 20339, "b": 353, "c": 353, "d": 353}
    assert tiny["gradients"]["d_minus_b_max"] == 0 and tiny["gradients"]["d_to_c_relative_l2"] < 1e-3
    own = tiny["memory"]["tensors_of_added_images"]
    for method in ("b", "d, at most 4 images retained"):
        peaks = tiny["memory"]["peaks"][method]
        assert peaks["55"] - peaks["9"] <= own
    text = (tmp_path / "benchmark.md").read_text()
    assert "| (d) gift-peft default | 353 | 3,268 |" in text and "extrapolated" in text
    if not torch.cuda.is_available():
        assert "vggt-1b: skipped, there is no CUDA device" in result.stdout and "were not run" in text
