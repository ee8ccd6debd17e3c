"""The private names of other libraries that we lean on: an upgrade that changes one fails here, by name.

Each says who uses it and what it must do. A private name in src that is not in `HOOKS` fails too.
"""

import re
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from torch import nn

SRC = Path(__file__).parents[1] / "src" / "gift_peft"

HOOKS = {  # private name: library, where we use it, what for
    "_PACKAGED_DATASETS_MODULES": ("datasets", "dataset/__init__.py", 'load_dataset("gift_i", data_dir=...)'),
    "_register_formatter": ("datasets", "dataset/rows.py", "checks each row as it is read"),
    "_reset_state": ("accelerate", "training/start.py", "a second run of one process with another precision"),
    "_gradient_checkpointing_func": ("transformers", "training/speed.py", "checkpointing of the encoder alone"),
    "_attn_implementation": ("transformers", "models/vggt/modeling_vggt.py", "which attention a model was asked for"),
    "_init_weights": ("transformers", "models/*/modeling_*.py", "the start of a network without weights"),
    "_parameters": ("torch", "memory.py", "lends a layer the cast of its weight for one forward"),
    "_compiled_call_impl": ("torch", "memory.py", "leaves compiled blocks alone"),
    "_DropoutNd": ("torch", "group_step.py", "finds every kind of dropout"),
    "_BatchNorm": ("torch", "group_step.py", "finds every kind of batch normalization"),
    "_actions": ("argparse", "options.py", "shows each option of the training arguments in one spelling"),
    "_option_string_actions": ("argparse", "options.py", "tells an option from a value"),
    "_optionals": ("argparse", "training/arguments.py", "takes the options of train out of their one group"),
    "_group_actions": ("argparse", "training/arguments.py", "and puts them into several"),
}


def gone(name: str) -> str:
    library, where, use = HOOKS[name]
    return f"{library} has changed {name}, which gift_peft/{where} needs for: {use}"


def test_every_private_name_of_a_library_is_listed_here():
    """Attributes with one underscore, of anything but self and cls, that no class or module of ours defines."""
    sources = {path: path.read_text(encoding="utf-8") for path in SRC.rglob("*.py")}
    ours = {name for text in sources.values() for name in re.findall(r"(?:def |class |self\.)(_[A-Za-z]\w*)", text)}
    ours |= {name for text in sources.values() for name in re.findall(r"^(_[A-Za-z]\w*)\b.* = ", text, flags=re.M)}
    for path, text in sources.items():
        for owner, name in re.findall(r"([\w\])]+)\.(_[A-Za-z]\w*)", text):
            assert owner in ("self", "cls") or name in ours or name in HOOKS, f"{path}: {owner}.{name}"
    everything = "\n".join(sources.values())
    assert [name for name in HOOKS if not re.search(rf"\.{name}\b", everything)] == []  # no longer used
    contributing = (SRC.parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert [name for name in HOOKS if name not in contributing] == []


def test_datasets():
    from datasets import formatting, packaged_modules

    modules = getattr(packaged_modules, "_PACKAGED_DATASETS_MODULES", None)
    assert isinstance(modules, dict), gone("_PACKAGED_DATASETS_MODULES")
    module, digest = modules["csv"]
    assert module.startswith("datasets.") and isinstance(digest, str), gone("_PACKAGED_DATASETS_MODULES")
    assert callable(getattr(formatting, "_register_formatter", None)), gone("_register_formatter")


def test_accelerate():
    from accelerate.state import AcceleratorState

    assert callable(getattr(AcceleratorState, "_reset_state", None)), gone("_reset_state")


def test_transformers_checkpoints_a_block_that_is_in_training_mode():
    from transformers.modeling_layers import GradientCheckpointingLayer

    class Block(GradientCheckpointingLayer):
        def forward(self, x):
            return 2 * x

    calls = []
    block = Block()
    block.gradient_checkpointing = True
    block._gradient_checkpointing_func = lambda function, *args: calls.append(1) or function(*args)
    block.train()
    assert block(torch.ones(1)) == 2 and calls == [1], gone("_gradient_checkpointing_func")
    block.eval()
    assert block(torch.ones(1)) == 2 and calls == [1], gone("_gradient_checkpointing_func")


def test_transformers_models():
    from transformers import PreTrainedConfig, PreTrainedModel

    assert hasattr(PreTrainedConfig(), "_attn_implementation"), gone("_attn_implementation")
    assert callable(getattr(PreTrainedModel, "_init_weights", None)), gone("_init_weights")


def test_transformers_argument_parser_is_a_file_that_stands_alone():
    """`training/arguments.py` executes it alone: with transformers would come our models, and torch."""
    from gift_peft.training.arguments import make_parser

    assert find_spec("transformers.hf_argparser") is not None, "transformers has moved HfArgumentParser"
    assert make_parser().knows("--learning-rate")


def test_torch_computes_with_what_lies_in_parameters():
    layer = nn.Linear(1, 1, bias=False)
    layer._parameters["weight"] = torch.full((1, 1), 3.0)  # a tensor and no Parameter, which setattr would refuse
    assert layer(torch.ones(1, 1)) == 3, gone("_parameters")


def test_torch_says_what_is_compiled():
    layer = nn.Linear(1, 1)
    assert layer._compiled_call_impl is None, gone("_compiled_call_impl")
    layer.compile()
    assert layer._compiled_call_impl is not None, gone("_compiled_call_impl")


@pytest.mark.parametrize("layer", [nn.Dropout(), nn.Dropout2d(), nn.AlphaDropout(), nn.FeatureAlphaDropout()])
def test_torch_dropout(layer):
    assert isinstance(layer, nn.modules.dropout._DropoutNd) and layer.p == 0.5, gone("_DropoutNd")


@pytest.mark.parametrize("layer", [nn.BatchNorm1d(1), nn.BatchNorm2d(1), nn.SyncBatchNorm(1)])
def test_torch_batch_norm(layer):
    assert isinstance(layer, nn.modules.batchnorm._BatchNorm), gone("_BatchNorm")


def test_argparse():
    import argparse

    parser = argparse.ArgumentParser()
    parser.add_argument("--size")
    assert "size" in {action.dest for action in parser._actions}, gone("_actions")
    assert "--size" in parser._option_string_actions, gone("_option_string_actions")
    assert "size" in {action.dest for action in parser._optionals._group_actions}, gone("_optionals")
    group = parser.add_argument_group("more")
    group._group_actions.append(parser._optionals._group_actions.pop())
    assert "more:\n  --size" in parser.format_help(), gone("_group_actions")
