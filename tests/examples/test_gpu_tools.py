"""The estimates for GPUs that nobody has here, and the script for the first one: they run, and count what is there."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gift_peft.adapters.recipes import get_gift_model
from gift_peft.training.profiling import count_flops

TOOLS = Path(__file__).parents[2] / "examples" / "tools"


@pytest.fixture
def roofline(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    for name in [name for name in sys.modules if name.split(".")[0] == "benchmark"]:
        monkeypatch.delitem(sys.modules, name)  # another test's file of that name
    import roofline

    return roofline


def counted(roofline, name="12-block"):
    config = roofline.CONFIGS[name]
    with torch.device("meta"):
        model = get_gift_model(config.build()).eval()
    return roofline.count(model, config.size), model, config.size


def test_arithmetic_is_that_of_the_profile(roofline):
    """Attention apart: fused, its backward computes the scores again."""
    work, model, size = counted(roofline)
    flops = count_flops(model, torch.empty(1, 3, *size))
    assert work.forward.flops() == pytest.approx(flops.forward, rel=1e-6)
    assert flops.backward < work.backward.flops() < 1.1 * flops.backward
    assert min(work.forward) > 0 and min(work.backward) > 0 and work.graph > 0


def test_a_better_gpu_is_faster_and_replays_cost(roofline):
    work, gpu = counted(roofline)[0], roofline.GPUS["rtx-4090"]
    now = roofline.epoch_seconds(work, gpu, 1e-5)
    assert now["kept"] == 1 and now["micro_batch"] == 8 and now["epoch"] == max(now["device"], now["host"])
    for name in ("matrix", "convolution", "attention", "bandwidth"):
        better = replace(gpu, **{name: 2 * getattr(gpu, name)})
        assert now["device"] / 2 < roofline.epoch_seconds(work, better, 1e-5)["device"] < now["device"]
    small = roofline.epoch_seconds(work, replace(gpu, memory=work.weights + 24 * work.graph), 1e-5)
    assert small["kept"] < 1 and small["device"] > now["device"]
    assert roofline.epoch_seconds(work, gpu, 1e-5, 2)["host"] > 2 * now["host"]


def test_the_first_gpu_run_runs_without_one():
    command = [
        sys.executable,
        "first_gpu_run.py",
        "--model",
        "tiny",
        "--device",
        "cpu",
        "--images",
        "3",
        "--updates",
        "1",
    ]
    result = subprocess.run(
        command, cwd=TOOLS, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    assert result.returncode == 0, result.stderr[-2000:]
    assert "| snapshot and replay | equal |" in result.stdout and "| micro-batch | 3 |" in result.stdout


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a CUDA device")
def test_without_a_gpu_the_script_says_so(tmp_path):
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    command = [str(TOOLS / "first_gpu_run.sh"), str(tmp_path / "out.md")]
    result = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PATH": path})
    assert result.returncode != 0 and "there is no CUDA device" in result.stderr
    assert not (tmp_path / "out.md").exists()
