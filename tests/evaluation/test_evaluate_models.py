"""`evaluate_gift_i` and `run_evaluation` end to end: the tiny model and its adapters on a tiny raw tree."""

import json
import re

import pytest
import torch
from accelerate import debug_launcher
from helpers.tiny import SIZE, tiny_model, tiny_processor, write_base, write_raw_tree

from gift_peft.adapters.recipes import get_gift_model
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.evaluation.evaluate import evaluate_gift_i
from gift_peft.evaluation.results import Report
from gift_peft.evaluation.verb import run_evaluation
from gift_peft.training.teacher import make_proxies


@pytest.fixture
def adapter_model(base_dir):
    from transformers import AutoModelForDepthEstimation

    torch.manual_seed(0)
    return get_gift_model(AutoModelForDepthEstimation.from_pretrained(base_dir), rank=2)


def shake(model):
    """Give every trainable weight of an adapter a small random change."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for weight in model.parameters():
            if weight.requires_grad:
                weight += 0.02 * torch.randn(weight.shape, generator=generator)
    return model


def test_an_identity_adapter_is_the_base_to_the_bit(raw_tree, adapter_model):
    report = evaluate_gift_i(load_gift_i(raw_tree, "validation"), adapter_model, size=SIZE, progress=False)
    assert report.summary == report.base
    assert report.gce["adapted"] == report.gce["base"] > 0
    assert report.collapse == {"target_mean_ratio": 1, "spread_ratio": 1, "alarm": False}
    assert all(row["base"] == row["adapted"] for row in report.rows)


def test_stored_proxies_and_those_made_on_the_way_agree(raw_tree, base_dir, adapter_model):
    shake(adapter_model)
    made = evaluate_gift_i(load_gift_i(raw_tree, "validation"), adapter_model, size=SIZE, progress=False)
    make_proxies(base_dir, raw_tree, splits=["validation"], size=SIZE)
    stored = load_gift_i(raw_tree, "validation", teacher=base_dir)
    assert evaluate_gift_i(stored, adapter_model, progress=False).to_dict() == made.to_dict()
    assert made.summary != made.base
    stored_base = evaluate_gift_i(stored, tiny_model(), processor=tiny_processor(), progress=False)
    assert stored_base.base == made.base


def test_modes_and_gradients_are_left_as_they_were(raw_tree, adapter_model):
    adapter_model.train()
    adapter_model.base_model.model.head.eval()
    frozen = next(weight for name, weight in adapter_model.named_parameters() if "lora_A" in name)
    frozen.requires_grad_(False)
    modes = [module.training for module in adapter_model.modules()]
    flags = [weight.requires_grad for weight in adapter_model.parameters()]
    evaluate_gift_i(
        load_gift_i(raw_tree, "validation"), adapter_model, processor=tiny_processor(), size=SIZE, progress=False
    )
    assert [module.training for module in adapter_model.modules()] == modes
    assert [weight.requires_grad for weight in adapter_model.parameters()] == flags


def test_a_dataset_without_true_depth_is_told(raw_tree):
    with pytest.raises(ValueError, match="no group of the dataset has true depth"):
        evaluate_gift_i(raw_tree, tiny_model(), processor=tiny_processor(), reference="depth", progress=False)


def test_the_train_split_has_gce_and_no_accuracy(raw_tree, adapter_model):
    report = evaluate_gift_i(load_gift_i(raw_tree, "train"), shake(adapter_model), size=SIZE, progress=False)
    assert report.gce["num_groups"] == 2 and report.counts["scored"] == 0 and report.counts["images"] == 5


def test_run_evaluation_prints_and_writes(raw_tree, base_dir, tmp_path, adapter_model, capsys):
    from gift_peft.adapters.folder import save_adapter

    adapter = tmp_path / "adapter"
    with pytest.warns(UserWarning, match="local"):
        save_adapter(shake(adapter_model), adapter, str(base_dir), processor=tiny_processor(), size=SIZE)
    out = tmp_path / "out"
    report = run_evaluation(base_dir, raw_tree, adapter, out=out, progress=False)
    printed = capsys.readouterr().out
    assert re.search(r"^ToM +base ", printed, re.MULTILINE) and "consensus" in printed
    assert "Protocol native" in printed and "\x1b" not in printed
    assert {path.name for path in out.iterdir()} == {"metrics.json", "rows.jsonl", "report.md"}
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["summary"] == report.summary and metrics["about"]["size"] == list(SIZE)
    rows = [json.loads(line) for line in (out / "rows.jsonl").read_text().splitlines()]
    assert rows == report.rows and len(rows) == 2
    same = run_evaluation(base_dir, raw_tree, adapter, adapter_scale=0, out=out, progress=False)
    assert same.summary == same.base == report.base


def _evaluate_in_two_processes(raw, out):
    from accelerate import Accelerator
    from accelerate.state import AcceleratorState

    AcceleratorState._reset_state(reset_partial_state=True)  # the parent's tests may have made one before the fork
    accelerator = Accelerator(cpu=True)
    model = shake_alone()
    report = evaluate_gift_i(
        load_gift_i(raw, "validation"),
        model,
        processor=tiny_processor(),
        size=SIZE,
        accelerator=accelerator,
        progress=False,
    )
    report.save(out / str(accelerator.process_index))


def shake_alone():
    torch.manual_seed(0)
    return shake(get_gift_model(tiny_model(), rank=2, head="none"))


def test_two_processes_give_the_report_of_one(tmp_path):
    raw = write_raw_tree(tmp_path / "raw", validation=(2, 3, 2))
    debug_launcher(_evaluate_in_two_processes, (raw, tmp_path), num_processes=2)
    one, two = (Report.load(tmp_path / rank) for rank in "01")
    assert one.to_dict() == two.to_dict() and one.rows == two.rows
    assert [row["group_id"] for row in one.rows] == [f"scene_{100 + g}" for g in (0, 0, 1, 1, 1, 2, 2)]
    alone = evaluate_gift_i(raw, shake_alone(), processor=tiny_processor(), size=SIZE, progress=False)
    assert alone.to_dict() == one.to_dict()


def test_paths_and_model_ids_are_accepted(raw_tree, base_dir, tmp_path):
    other = write_base(tmp_path / "other", seed=1)
    from gift_peft.models.loading import DepthModel

    model = DepthModel.from_pretrained(other).network
    report = evaluate_gift_i(raw_tree, model, str(base_dir), size=SIZE, progress=False)
    expected = evaluate_gift_i(raw_tree, tiny_model(), processor=tiny_processor(), size=SIZE, progress=False)
    assert report.base == expected.base and report.summary != report.base
