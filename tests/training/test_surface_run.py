"""Runs with `target: surface`: what they compute, how they go on, and what is refused."""

import json
import os
import signal
import subprocess
import sys

import pytest
import torch
from helpers.runs import (
    arguments,
    assert_same_run,
    rows_of,
    run_in_child,
    run_in_processes,
    train_again,
    weights,
)
from helpers.tiny import SIZE, tiny_processor, write_group, write_raw_tree

from gift_peft import get_gift_model
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.light import epoch_light, in_light
from gift_peft.dataset.loader import PreparedGroups, PreparedImages, epoch_flips, epoch_order
from gift_peft.dataset.proxies import SurfaceSettings
from gift_peft.models.loading import load_base
from gift_peft.training import GiftTrainingArguments, train
from gift_peft.training.schedule import Schedule
from gift_peft.training.surface_step import SurfaceStep

pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning")

FILLS = 1
JITTER = 0.2
SURFACE = {"target": "surface", "fills": FILLS, "per_device_train_batch_size": 2, "flip": True, "color_jitter": JITTER}


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """Seven photos: a group of three, of one, of two and again of one."""
    return write_raw_tree(tmp_path_factory.mktemp("tree") / "raw", train=(3, 1, 2, 1))


@pytest.fixture(scope="module")
def whole(base_dir, tree, tmp_path_factory):
    """An uninterrupted run of two epochs, four updates each, the last of one image."""
    out = tmp_path_factory.mktemp("whole") / "out"
    train(arguments(base_dir, tree, out, **SURFACE))
    return out


@pytest.fixture(scope="module")
def groups(base_dir, tree, whole):
    rows = load_gift_i(tree, "train", teacher=base_dir, size=SIZE, surface=SurfaceSettings(fills=FILLS))
    return PreparedGroups(rows, tiny_processor(), SIZE, num_threads=0)


@pytest.fixture
def args(base_dir, tree, tmp_path):
    return arguments(base_dir, tree, tmp_path / "out", **SURFACE)


# ---- what is computed ----


def by_hand(model, groups, order, lambdas=(1.5, 1.0)):
    """The mean loss of the images `order` lists as (index, flipped, light): straight from the formula."""
    places = [(row, image) for row in range(len(groups)) for image in range(len(groups[row].names))]
    total, terms = 0, torch.zeros(2)
    for index, flip, light in order:
        row, image = places[index]
        group = groups[row]
        turn = [-1] if flip else []
        target = (group.surface_target_flipped if flip else group.surface_target)[image]
        pixels = in_light(group.pixel_values[image : image + 1], light[None], tiny_processor())
        prediction = model(pixel_values=pixels.flip(turn)).predicted_depth[0]
        mask = group.mask[image].flip(turn)
        difference = (prediction - target).abs()
        inside = difference[mask].mean() if mask.any() else 0 * difference.sum()
        difference = torch.where(difference <= target.abs().max() * 2**-18, 0, difference)  # rounding has no sign
        outside = 2 * difference[~mask].mean()
        total = total + lambdas[0] * inside + lambdas[1] * outside
        terms += torch.tensor([inside.item(), outside.item()])
    return total / len(order), terms / len(order)


def test_a_run_is_adam_on_the_formula(base_dir, whole, groups):
    torch.manual_seed(0)
    base, _ = load_base(base_dir)
    model = get_gift_model(base)
    parameters = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(parameters, lr=2e-4)
    order, flips = epoch_order(7, 0, 0), epoch_flips(7, 0, 0)
    items = list(zip(order, flips, epoch_light(7, JITTER, 0, 0), strict=True))
    means = torch.zeros(3, dtype=torch.float64)
    for start in (0, 2, 4, 6):
        batch = items[start : start + 2]
        loss, terms = by_hand(model, groups, batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        means += torch.tensor([loss.item(), *terms.tolist()]).double() * len(batch) / 7
    row = rows_of(whole)[1]
    assert (row["step"], row["epoch"], row["train_gce"]) == (4, 1, None)
    got = [row[name] for name in ("loss", "consistency", "distillation")]
    assert got == pytest.approx(means.tolist(), rel=2e-4)


def test_the_first_row_is_the_base(whole, groups):
    distances = [
        (proxy - target).abs()[mask].mean().item()
        for group in (groups[row] for row in range(len(groups)))
        for proxy, target, mask in zip(group.target, group.surface_target, group.mask, strict=True)
    ]
    row = rows_of(whole)[0]
    assert row["consistency"] == pytest.approx(sum(distances) / 7, rel=1e-5)
    assert row["loss"] == pytest.approx(1.5 * row["consistency"]) and row["distillation"] == 0
    assert row["train_gce"] is None and row["val_gce"] > 0
    assert list(row) == list(rows_of(whole)[2])


def test_the_target_is_learned(base_dir, tree, tmp_path):
    train(
        arguments(
            base_dir, tree, tmp_path / "out", **SURFACE | {"flip": False, "color_jitter": 0.0}, num_train_epochs=12
        )
    )
    rows = rows_of(tmp_path / "out")
    assert rows[-1]["consistency"] < 0.8 * rows[0]["consistency"]


def test_images_of_any_groups_make_an_update(groups):
    images = PreparedImages(groups)
    assert len(images) == 7
    first = images.read(4)
    assert first.names == ["scene_2/0.png"] and first.pixel_values.shape == (1, 3, *SIZE)
    mirrored = images.read(4, flip=True)
    group = groups[2]
    assert torch.equal(mirrored.pixel_values, group.pixel_values[:1].flip(-1))
    assert torch.equal(mirrored.mask, group.mask[:1].flip(-1))
    assert torch.equal(mirrored.surface_target, group.surface_target_flipped[:1])
    assert torch.equal(first.surface_target, group.surface_target[:1]) and first.surface_target_flipped is None
    flips = epoch_flips(1000, 0, 3)
    assert flips == epoch_flips(1000, 0, 3) != epoch_flips(1000, 0, 4) and 400 < sum(flips) < 600


def test_the_adapter_says_what_it_was_trained_to(whole):
    record = json.loads((whole / "adapter/gift.json").read_text())
    assert record["arguments"]["target"] == "surface" and record["arguments"]["lambda_c"] == 1.5
    assert record["arguments"]["fills"] == FILLS and "retain" not in record["arguments"]
    assert record["arguments"]["micro_batch_size"] == 2  # what "auto" came to
    assert record["num_groups"] == 4 and record["epoch"] in (1, 2)
    card = (whole / "adapter/README.md").read_text()
    assert "target: surface" in card and "distance to the surface target : distillation = 1.5:1" in card
    assert "2 images of any groups per update" in card and "one update per group" not in card
    config = (whole / "config.yaml").read_text()
    assert "target: surface" in config and "retain" not in config


# ---- going on ----


@pytest.mark.parametrize("number", [1, 2, 6])
def test_a_killed_run_goes_on_to_the_bit(args, whole, tmp_path, number):
    accumulate, calls = SurfaceStep.accumulate, []

    def killed(*given, **options):
        calls.append(1)
        if len(calls) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return accumulate(*given, **options)

    def work():
        SurfaceStep.accumulate = killed
        train(args)

    assert run_in_child(work) == -signal.SIGKILL
    train_again(args)
    assert_same_run(tmp_path / "out", whole)


def test_the_micro_batch_and_the_threads_do_not_matter(args, whole, base_dir, tree, tmp_path):
    more = SURFACE | {"per_device_train_batch_size": 1, "gradient_accumulation_steps": 2, "dataloader_num_workers": 0}
    train(arguments(base_dir, tree, tmp_path / "out", **more, checkpointing_steps=None))
    assert_close_run(tmp_path / "out", whole)
    checkpoint = sorted((tmp_path / "out").glob("checkpoint-*"))[0]
    assert checkpoint.name == "checkpoint-4"
    for change in ({"per_device_train_batch_size": 4}, {"fills": 2}, {"flip": False}, {"color_jitter": 0.0}):
        with pytest.raises(ValueError, match=r"changed since the checkpoint|stale surface target"):
            train_again(GiftTrainingArguments(**{**vars(args), **more}), **change)


def assert_close_run(out, expected):
    """The same run up to the rounding of sums."""
    for ours, theirs in zip(rows_of(out), rows_of(expected), strict=True):
        assert {key: value or 0 for key, value in ours.items()} == pytest.approx(
            {key: value or 0 for key, value in theirs.items()}, rel=1e-3
        )
    ours, theirs = weights(out / "adapter-last"), weights(expected / "adapter-last")
    assert max((ours[key] - theirs[key]).abs().max() for key in theirs) < 2e-4  # Adam: one update's step


def test_two_processes_make_the_run_of_one(base_dir, tree, whole, tmp_path):
    one = arguments(base_dir, tree, tmp_path / "out", **SURFACE | {"per_device_train_batch_size": 1})
    assert run_in_processes(lambda rank: train(one)) == [0, 0]
    assert_close_run(tmp_path / "out", whole)
    assert json.loads((tmp_path / "out/adapter/gift.json").read_text())["num_processes"] == 2


@pytest.mark.slow
def test_torchrun(base_dir, tree, tmp_path):
    """The line of docs/several-gpus.md, on CPUs."""
    options = {"size": "56x70", "max_steps": 2, "output_dir": tmp_path / "out", "target": "surface", "fills": FILLS}
    options |= {"model_name_or_path": base_dir, "dataset_name": tree}
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    command = [*launch, "-m", "gift_peft.training", *(f"--{key}={value}" for key, value in options.items())]
    environment = os.environ | {"ACCELERATE_USE_CPU": "true", "OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr[-2000:]
    assert json.loads((tmp_path / "out/adapter/gift.json").read_text())["num_processes"] == 2


# ---- what is refused ----


def test_a_group_of_one_is_refused_by_consensus_alone(base_dir, tree, tmp_path):
    with pytest.raises(ValueError) as excinfo:
        train(arguments(base_dir, tree, tmp_path / "out"))
    assert "group scene_1 has 1 different image; it takes two to compare" in str(excinfo.value)
    assert "--target surface" in str(excinfo.value) and not (tmp_path / "out/metrics.jsonl").exists()


def test_targets_of_other_settings_are_refused(args):
    with pytest.raises(ValueError) as excinfo:
        train(GiftTrainingArguments(**{**vars(args), "surface_tau": 0.6}))
    message = str(excinfo.value)
    assert "made with surface_tau 0.5, not 0.6" in message and "\n" not in message
    assert "--target surface" in message and "--surface_tau 0.6 --overwrite`" in message


REFUSED = {
    "flip": ({"flip": True}, "target: consensus does not take it"),
    "fills": ({"fills": 2}, "consensus does not take it"),
    "per_device_train_batch_size": ({"per_device_train_batch_size": 2}, "consensus does not take it"),
    "gradient_accumulation_steps": ({"gradient_accumulation_steps": 2}, "consensus does not take it"),
    "surface_model": ({"surface_model": "plane"}, "consensus does not take it"),
    "surface_tau": ({"target": "surface", "surface_tau": 1.0}, "between 0 and 1"),
    "retain": ({"target": "surface", "retain": "0"}, "target: surface does not take it"),
    "profile": ({"target": "surface", "profile": 2}, "surface does not take it"),
    "target": ({"target": "median"}, "neither consensus nor surface"),
    "warmup_steps": ({"warmup_steps": -1}, "must be finite and not negative"),
    "max_grad_norm": ({"max_grad_norm": -1.0}, "must be finite and not negative"),
    "metric_for_best_model": ({"metric_for_best_model": "loss"}, "gce, normalized_gce, tom_rmse"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_combinations_that_make_no_sense(name):
    changes, words = REFUSED[name]
    with pytest.raises(ValueError, match=f"^{name}.*{words}"):
        GiftTrainingArguments("base", "data", "out", **changes)


def test_bad_masks_train_all_the_same(base_dir, tmp_path):
    """A mask over the whole photo, a target of one pixel, masks that do not meet, and no pixel in common."""
    import numpy as np
    from PIL import Image

    raw = write_raw_tree(tmp_path / "raw", train=(2, 2, 2))
    masks = np.zeros((3, 2, 60, 80), np.uint8)
    masks[0], masks[1, :, 30, 41] = 255, 255
    masks[2, 0, :, :40], masks[2, 1, :, 40:] = 255, 255
    for number, pair in enumerate(masks):
        for index, mask in enumerate(pair):
            Image.fromarray(mask).save(raw / f"train/scene_{number}/masks/{index}.png")
    train(arguments(base_dir, raw, tmp_path / "out", **SURFACE, num_train_epochs=1))
    assert all(value is None or value == value for value in rows_of(tmp_path / "out")[-1].values())


# ---- for both objectives ----


def test_clipping_and_warmup(base_dir, tree, tmp_path, monkeypatch):
    norms, rates, step = [], [], torch.optim.Adam.step

    def recorded(self, *given, **options):
        parameters = self.param_groups[0]["params"]
        norms.append(torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None]).item())
        rates.append(self.param_groups[0]["lr"])
        return step(self, *given, **options)

    monkeypatch.setattr(torch.optim.Adam, "step", recorded)
    options = {"max_grad_norm": 0.01, "warmup_steps": 3, "learning_rate": 4e-4, "lr_scheduler_type": "linear"}
    pairs = write_raw_tree(tmp_path / "pairs")
    for data, changes in ((pairs, {"num_train_epochs": 3}), (tree, SURFACE | {"max_steps": 6})):
        norms.clear(), rates.clear()
        train(arguments(base_dir, data, tmp_path / f"out{len(changes)}", **changes, **options))
        assert max(norms) <= 0.01 * (1 + 1e-4)
        assert rates == pytest.approx([1e-4, 2e-4, 3e-4, 4e-4, 4e-4 * 2 / 3, 4e-4 / 3])
    plain = Schedule(GiftTrainingArguments("b", "d", "o", max_steps=10), 5)
    assert plain.learning_rate(0) == 2e-5


def test_what_chooses_the_adapter(base_dir, tree, tmp_path):
    for metric in ("normalized_gce", "tom_rmse"):
        out = tmp_path / metric
        result = train(arguments(base_dir, tree, out, **SURFACE, metric_for_best_model=metric))
        rows = rows_of(out)
        assert ("val_normalized_gce" in rows[0]) == (metric == "normalized_gce")
        assert result.best_step == min(rows[1:], key=lambda row: row[f"val_{metric}"])["step"]


def test_nothing_to_choose_by(base_dir, tmp_path, capsys):
    raw = write_raw_tree(tmp_path / "raw", train=(1, 2), validation=())
    write_group(raw / "validation/scene_100", 2, 100)
    result = train(arguments(base_dir, raw, tmp_path / "out", **SURFACE, metric_for_best_model="tom_rmse"))
    assert result.best_step is None and "has a photo of the treated surface" in capsys.readouterr().out
    assert weights(tmp_path / "out/adapter").keys() == weights(tmp_path / "out/adapter-last").keys()
