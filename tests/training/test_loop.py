"""A run from raw tree to adapter: what it computes, what it leaves on disk, and what it refuses."""

import itertools
import json
import shutil

import pytest
import torch
from helpers.booster_tree import write_root
from helpers.runs import arguments, rows_of, tell, train_again, weights
from helpers.tiny import SIZE, tiny_processor, write_raw_tree
from peft import PeftModel
from safetensors.torch import load_file
from transformers import AutoModelForDepthEstimation

from gift_peft import evaluate_booster, get_gift_model
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.loader import PreparedGroups, epoch_order
from gift_peft.evaluation.evaluate import evaluate_gift_i
from gift_peft.losses import geometry_consistency_error
from gift_peft.training import GiftTrainingArguments, loop, train

# transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning")

KEYS = ["step", "epoch", "loss", "consistency", "distillation", "train_gce", "val_gce"] + [
    f"val_{region}_{metric}" for region in ("tom", "other", "all") for metric in ("mae", "abs_rel", "rmse", "delta1")
]


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return write_raw_tree(tmp_path_factory.mktemp("tree") / "raw", train=(2, 3, 2))


@pytest.fixture(scope="module")
def run(base_dir, tree, tmp_path_factory):
    """(result, the model it trained, bytes of the base before) of a run of three epochs."""
    out = tmp_path_factory.mktemp("run") / "out"
    before = (base_dir / "model.safetensors").read_bytes()
    captured = []

    def keep(*args, **options):
        captured.append(get_gift_model(*args, **options))
        return captured[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "get_gift_model", keep)
        result = train(arguments(base_dir, tree, out, num_train_epochs=3, checkpointing_steps=None, seed=3))
    return result, captured[0], before


@pytest.fixture(scope="module")
def groups(base_dir, tree):
    """{split: groups with proxies} after the run has made them."""

    def prepared(split):
        rows = load_gift_i(tree, split, teacher=base_dir, size=(56, 70))
        return PreparedGroups(rows, tiny_processor(), (56, 70), num_threads=0)

    return prepared


def test_metrics_have_the_documented_keys_and_rows(run):
    result, _, _ = run
    rows = rows_of(result.output_dir)
    assert rows == result.metrics
    assert [(row["step"], row["epoch"]) for row in rows] == [(0, 0), (3, 1), (6, 2), (9, 3)]
    assert all(list(row) == KEYS for row in rows)


def test_training_lowers_loss_and_gce(run):
    rows = run[0].metrics
    assert rows[-1]["loss"] < rows[1]["loss"]
    assert rows[-1]["val_gce"] < rows[0]["val_gce"]


def test_row_zero_is_the_base(run, groups, base_dir):
    row = run[0].metrics[0]
    train_groups = groups("train")
    gce = geometry_consistency_error((group.target, group.mask) for group in map(train_groups.__getitem__, range(3)))
    assert row["train_gce"] == row["loss"] == row["consistency"] == pytest.approx(gce, rel=1e-6)
    assert row["distillation"] == 0
    base = AutoModelForDepthEstimation.from_pretrained(base_dir)
    report = evaluate_gift_i(groups("validation"), base, kind="inverse_depth", progress=False)
    assert row["val_gce"] == report.gce["base"]
    assert row["val_tom_rmse"] == report.summary["tom"]["rmse"]


def test_arguments_may_be_given_one_by_one(base_dir, tree, tmp_path):
    given = {"model_name_or_path": base_dir, "dataset_name": tree, "output_dir": tmp_path / "out", "size": "56x70"}
    assert train(**given, max_steps=1).step == 1
    args = GiftTrainingArguments(**given)
    with pytest.raises(TypeError, match="not both: max_steps, seed"):
        train(args, max_steps=2, seed=1)
    with pytest.raises(TypeError, match="lerning_rate"):
        train(**given, lerning_rate=1e-3)
    with pytest.raises(TypeError, match="output_dir"):
        train(model_name_or_path="m", dataset_name="d")
    assert train(args=GiftTrainingArguments(**given, max_steps=2, resume_from_checkpoint="latest")).step == 2


def test_booster_is_measured_where_a_root_is_given(base_dir, tree, tmp_path):
    write_root(tmp_path / "booster")
    args = arguments(base_dir, tree, tmp_path / "out", max_steps=1, booster_root=str(tmp_path / "booster"))
    rows = train(args).metrics
    assert [list(row) for row in rows] == [[*KEYS, "booster_tom_rmse", "booster_other_rmse"]] * 2
    base = AutoModelForDepthEstimation.from_pretrained(base_dir)
    options = {"processor": tiny_processor(), "size": SIZE, "progress": False}
    report = evaluate_booster(tmp_path / "booster", base, **options)
    assert rows[0]["booster_tom_rmse"] == report.summary["tom"]["rmse"]
    adapted = PeftModel.from_pretrained(base, tmp_path / "out" / "adapter-last")
    report = evaluate_booster(tmp_path / "booster", adapted, **options)
    assert rows[1]["booster_other_rmse"] == report.summary["other"]["rmse"] != report.base["other"]["rmse"]
    with pytest.raises(FileNotFoundError, match=r"Booster root .*nowhere: no such folder"):
        train(arguments(base_dir, tree, tmp_path / "none", booster_root=str(tmp_path / "nowhere")))
    assert not any((tmp_path / "none").iterdir())


def test_teacher_is_untouched_and_the_saved_adapter_is_the_trained_one(run, base_dir, groups):
    result, model, before = run
    assert (base_dir / "model.safetensors").read_bytes() == before
    pixel_values = groups("train")[0].pixel_values
    base = AutoModelForDepthEstimation.from_pretrained(base_dir).eval()
    with torch.no_grad():
        expected = base(pixel_values=pixel_values).predicted_depth
        trained = model(pixel_values=pixel_values).predicted_depth
        with model.disable_adapter():
            assert torch.equal(model(pixel_values=pixel_values).predicted_depth, expected)
        loaded = PeftModel.from_pretrained(base, result.output_dir / "adapter-last").eval()
        assert torch.equal(loaded(pixel_values=pixel_values).predicted_depth, trained)
    assert not torch.equal(trained, expected)


def test_adapter_has_the_smallest_validation_gce(run, base_dir, groups):
    result = run[0]
    best = min(result.metrics[1:], key=lambda row: row["val_gce"])
    assert result.best_step == best["step"]
    gift = json.loads((result.output_dir / "adapter/gift.json").read_text())
    assert (gift["step"], gift["metrics"]["adapter"], gift["metrics"]["base"]) == (
        best["step"],
        best,
        result.metrics[0],
    )
    model = PeftModel.from_pretrained(
        AutoModelForDepthEstimation.from_pretrained(base_dir), result.output_dir / "adapter"
    )
    report = evaluate_gift_i(groups("validation"), model, kind="inverse_depth", progress=False)
    assert report.gce["adapted"] == best["val_gce"]


@pytest.mark.parametrize(("delay", "validated"), [(2, [0, 6, 9]), (9, [0, 9])])
def test_eval_delay_leaves_early_epochs_out_of_the_choice(run, base_dir, tree, tmp_path, delay, validated):
    full = run[0].metrics
    args = arguments(base_dir, tree, tmp_path, num_train_epochs=3, checkpointing_steps=None, seed=3, eval_delay=delay)
    result = train(args)
    late = [row for row in full if row["step"] in validated]
    assert [row for row in result.metrics if row["val_gce"] is not None] == late  # and the weights are the same
    assert [list(row) for row in result.metrics] == [KEYS] * 4
    assert result.best_step == min(late[1:], key=lambda row: row["val_gce"])["step"]


def test_first_distillation_is_exactly_zero(base_dir, tree, tmp_path):
    result = train(arguments(base_dir, tree, tmp_path / "out", max_steps=1))
    assert result.metrics[1]["distillation"] == 0
    assert result.metrics[1]["loss"] == result.metrics[1]["consistency"] > 0
    assert result.metrics[1]["epoch"] == pytest.approx(1 / 3)


def test_checkpoints_are_pruned_but_not_the_named_ones(base_dir, tree, tmp_path):
    out = tmp_path / "out"
    train(arguments(base_dir, tree, out, checkpoint_at_steps=[1, 3], checkpoints_total_limit=2))
    assert sorted(folder.name for folder in out.glob("checkpoint-*")) == [f"checkpoint-{n}" for n in (1, 3, 5, 6)]
    PeftModel.from_pretrained(AutoModelForDepthEstimation.from_pretrained(base_dir), out / "checkpoint-1")


def test_without_validation_adapter_is_the_last(base_dir, tree, tmp_path, capsys):
    shutil.copytree(tree / "train", tmp_path / "raw/train")
    result = train(arguments(base_dir, tmp_path / "raw", tmp_path / "out"))
    assert "No validation split" in capsys.readouterr().out
    assert result.best_step is None
    assert result.metrics[-1]["val_gce"] is None
    best, last = weights(tmp_path / "out/adapter"), weights(tmp_path / "out/adapter-last")
    assert all(torch.equal(best[key], last[key]) for key in last)


def test_other_heads_and_a_spelled_out_recipe(base_dir, tree, tmp_path):
    train(arguments(base_dir, tree, tmp_path / "lora", max_steps=1, head="lora"))
    assert not any(key.endswith("head.conv1.weight") for key in weights(tmp_path / "lora/adapter"))
    recipe = {"target_modules": r".*\.q_proj", "modules_to_save": ["head"], "prediction_kind": "depth"}
    train(arguments(base_dir, tree, tmp_path / "own", max_steps=1, **recipe))
    keys = weights(tmp_path / "own/adapter").keys()
    assert any("q_proj" in key for key in keys)
    assert not any("v_proj" in key or "neck" in key for key in keys)
    assert json.loads((tmp_path / "own/adapter/gift.json").read_text())["kind"] == "depth"


def test_bf16_is_recorded_and_trains(base_dir, tree, tmp_path):
    result = train(arguments(base_dir, tree, tmp_path / "out", max_steps=2, mixed_precision="bf16"))
    assert json.loads((tmp_path / "out/adapter/gift.json").read_text())["mixed_precision"] == "bf16"
    assert all(value.dtype == torch.float32 for value in weights(tmp_path / "out/adapter").values())
    assert result.metrics[0]["distillation"] == 0


def test_tensorboard_logs(base_dir, tree, tmp_path):
    pytest.importorskip("tensorboard")
    train(arguments(base_dir, tree, tmp_path / "out", max_steps=1, report_to="tensorboard"))
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = [path.parent for path in (tmp_path / "out/logs").rglob("events*")]
    tags = set()
    for folder in events:
        tags |= set(EventAccumulator(str(folder)).Reload().Tags()["scalars"])
    assert {"loss", "consistency", "distillation", "train_gce", "val_gce", "val_tom_rmse"} <= tags


def test_the_order_is_a_permutation_of_seed_and_epoch():
    assert sorted(epoch_order(7, 0, 0)) == list(range(7))
    assert epoch_order(7, 1, 2) == epoch_order(7, 1, 2)
    assert len({tuple(epoch_order(7, seed, epoch)) for seed in range(3) for epoch in range(3)}) == 9


@pytest.mark.parametrize(("threads", "cache"), [(0, False), (2, False), (2, True)])
def test_prepared_groups_come_in_order_whatever_threads_and_cache(groups, run, threads, cache, tmp_path):
    plain = groups("train")
    prepared = PreparedGroups(plain.dataset, tiny_processor(), (56, 70), threads, tmp_path / "c" if cache else None)
    for order in ([2, 0, 1], [1, 2, 0]):
        taken = list(prepared.take(order))
        assert [group.group_id for group in taken] == [plain[index].group_id for index in order]
        assert all(torch.equal(group.target, plain[i].target) for group, i in zip(taken, order, strict=True))
        assert all(torch.equal(g.pixel_values, plain[i].pixel_values) for g, i in zip(taken, order, strict=True))
    assert len(list(tmp_path.rglob("*.safetensors"))) == (3 if cache else 0)
    endless = prepared.take(itertools.cycle([1, 0]))
    assert [next(endless).group_id for _ in range(5)] == [plain[index].group_id for index in (1, 0, 1, 0, 1)]
    endless.close()


def test_optimizer_state_covers_the_trained_weights(run):
    state = load_file(run[0].output_dir / "checkpoint-9/optimizer.safetensors")
    trained = {name for name, p in run[1].named_parameters() if p.requires_grad}
    named = {key.rsplit(".", 1)[0] for key in state}
    # The first fusion layer of a DPT neck has no residual input, so four of its weights never get a gradient.
    assert {name for name in trained - named if "fusion_stage.layers.0.residual_layer1" not in name} == set()
    assert named <= trained


def test_recomputed_blocks_and_retained_graphs_do_not_change_a_bit(base_dir, tree, tmp_path, capsys):
    runs = {"plain": {"retain": 0}, "checkpointed": {"gradient_checkpointing": True}}
    for name, changes in runs.items():
        train(arguments(base_dir, tree, tmp_path / name, max_steps=2, **changes))
    assert capsys.readouterr().out.count("retain auto: up to") == 1
    plain, checkpointed = (weights(tmp_path / name / "adapter-last") for name in runs)
    assert all(torch.equal(checkpointed[key], plain[key]) for key in plain)


def test_an_option_that_changes_the_bits_is_near_and_may_not_be_changed_on_the_way(base_dir, tree, tmp_path):
    args = arguments(base_dir, tree, tmp_path / "out", max_steps=2, channels_last=True)
    train(args)
    other = arguments(base_dir, tree, tmp_path / "plain", max_steps=2, channels_last=False)
    train(other)
    got, plain = weights(tmp_path / "out/adapter-last"), weights(tmp_path / "plain/adapter-last")
    for key in plain:
        torch.testing.assert_close(got[key], plain[key], rtol=0, atol=2.5 * 2 * args.learning_rate)  # Adam's signs
    with pytest.raises(ValueError, match="channels_last: True became False"):
        train_again(args, channels_last=False, max_steps=3)
    train_again(other, channels_last=None, max_steps=3)  # unless asked, a run keeps what it began with
    assert "channels_last: false" in (tmp_path / "plain/config.yaml").read_text()


@pytest.mark.parametrize("told", [False, None])
def test_a_checkpoint_that_does_not_tell_its_layout_goes_on_in_pytorchs_own(base_dir, tree, tmp_path, told):
    """As written before channels-last was an option (None: nothing is told), or where it was not the default."""
    out = tmp_path / "out"
    args = arguments(base_dir, tree, out, max_steps=3, channels_last=False)
    train(args)
    tell(out / "checkpoint-3", channels_last=told)
    with pytest.raises(ValueError, match="channels_last: False became True"):
        train_again(args, channels_last=True, max_steps=4)
    train_again(args, channels_last=None, max_steps=4)
    assert "channels_last: false" in (out / "config.yaml").read_text()
