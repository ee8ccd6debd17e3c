"""No network, one thread, and the tiny pieces most tests start from."""

import os

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import datasets
import pytest
import torch
from helpers.group_tools import DTYPES, gift_model
from helpers.records import records
from helpers.runs import arguments
from helpers.tiny import tiny_model, write_base, write_raw_tree

from gift_peft.dataset.writer import write_gift_i
from gift_peft.training import train

torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def cache_home(tmp_path_factory):
    """Our caches (proxies of read-only datasets, groups at network size) stay out of the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("huggingface_hub.constants.HF_HOME", str(tmp_path_factory.mktemp("hf_home")))
        yield


@pytest.fixture
def model():
    """A fresh tiny Depth Anything, float32, eval."""
    return tiny_model()


@pytest.fixture(scope="module", params=DTYPES)
def model_of(request):
    """The tiny model with an adapter, in float64 and in float32; shared within a file."""
    return gift_model(DTYPES[request.param])


@pytest.fixture(scope="session")
def base_dir(tmp_path_factory):
    """The tiny model as a transformers folder; read only."""
    return write_base(tmp_path_factory.mktemp("base"))


@pytest.fixture
def raw_tree(tmp_path):
    """RAW with two train groups (2 and 3 images) and one validation group (2 images and a reference)."""
    return write_raw_tree(tmp_path / "raw")


@pytest.fixture
def prepared(tmp_path, raw_tree):
    """The groups of `raw_tree` as a prepared folder, with valid masks and depths for some of them."""
    return write_gift_i(records(raw_tree), tmp_path / "gift-i", license="cc0-1.0", pretty_name="Tiny: a test")


@pytest.fixture
def fresh_cache(tmp_path_factory, monkeypatch):
    """No test sees what another, or the user, has cached."""
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A raw tree of two train groups and one validation group."""
    return write_raw_tree(tmp_path_factory.mktemp("tree") / "raw")


@pytest.fixture(scope="module")
def whole(base_dir, tree, tmp_path_factory):
    """An uninterrupted run of four updates."""
    out = tmp_path_factory.mktemp("whole") / "out"
    train(arguments(base_dir, tree, out))
    return out
