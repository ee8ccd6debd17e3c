"""`import gift_peft`: light, and datasets and transformers know what is ours, whichever is imported first."""

import importlib.util
import subprocess
import sys

import pytest

import gift_peft


def python(code, *words):
    """The output of a fresh interpreter."""
    done = subprocess.run([sys.executable, *code, *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_import_is_light():
    heavy = "{'torch', 'transformers', 'datasets', 'peft', 'cv2', 'pandas', 'pyarrow', 'numpy', 'PIL', 'yaml'}"
    out = python(["-c", f"import sys, gift_peft; gift_peft.__version__; print({heavy} & {{*sys.modules}})"])
    assert out == "set()\n"


def test_public_names_are_there_and_no_module_has_one():
    for name in gift_peft.__all__:
        assert getattr(gift_peft, name) is not None
        assert importlib.util.find_spec(f"gift_peft.{name}") is None, f"{name} is a module too"
    assert {"train", "prepare_gift_i", "load_gift_i"} <= {*gift_peft.__all__} <= {*dir(gift_peft)}
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = gift_peft.nothing


LOAD = """
import sys
{imports}
if __name__ == "__main__":
    import multiprocess
    multiprocess.set_start_method("spawn")
    datasets.config.HF_DATASETS_CACHE = sys.argv[2]
    rows = datasets.load_dataset("gift_i", data_dir=sys.argv[1], split="train", num_proc={num_proc})
    print(rows["group_id"][:])
"""


@pytest.mark.parametrize(
    ("imports", "num_proc"),
    [
        ("import gift_peft\nimport datasets", 2),
        ("import datasets\nimport gift_peft", 2),
        ("import gift_peft.dataset.rows\nimport datasets", None),  # halfway through it, datasets is imported
        (
            "import importlib.machinery as m\nm.SourceFileLoader.get_source = lambda *_: None  # as where none are\n"
            "import gift_peft, datasets",
            None,
        ),
    ],
    ids=["after", "before", "within", "without sources"],
)
def test_load_dataset_finds_the_builder(imports, num_proc, raw_tree, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(LOAD.format(imports=imports, num_proc=num_proc))
    out = python([script], raw_tree, tmp_path / "cache")
    assert out == "['scene_0', 'scene_1']\n"


@pytest.mark.parametrize(
    "imports",
    [
        "import gift_peft, transformers.models.dinov2.modeling_dinov2",
        "import transformers, gift_peft",
        pytest.param("import gift_peft.models.metric3d", marks=pytest.mark.slow),  # halfway through it, transformers
    ],
)
def test_auto_classes_know_the_models(imports):
    code = f"""
{imports}
from transformers import AutoConfig, AutoImageProcessor, AutoModelForDepthEstimation
import torch
with torch.device("meta"):
    model = AutoModelForDepthEstimation.from_config(AutoConfig.for_model("gift_metric3d", variant="small"))
print(type(model).__name__, type(AutoConfig.for_model("gift_vggt")).__name__)
"""
    assert python(["-c", code]) == "Metric3DForDepthEstimation VggtConfig\n"


def test_a_look_is_no_import():
    code = """
import importlib.util, sys, gift_peft
assert importlib.util.find_spec("datasets") and importlib.util.find_spec("transformers")
assert not {"datasets", "transformers", "torch"} & {*sys.modules}
"""
    python(["-c", code])
