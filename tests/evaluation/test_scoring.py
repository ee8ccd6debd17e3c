"""Groups are scored in threads while the next are predicted: the same rows, few groups at once, errors as ever."""

import threading

import numpy as np
import pytest
import torch
from accelerate import Accelerator
from helpers.runs import run_in_processes
from helpers.tiny import SIZE, tiny_model, tiny_processor

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.tensors import Group
from gift_peft.evaluation import scoring
from gift_peft.evaluation.evaluate import REFERENCES, evaluate_gift_i, evaluate_references
from gift_peft.models.loading import DepthModel

LONG = 60  # seconds; nothing waits for so long


def make_group(seed: int, count: int = 2, size: tuple[int, int] = (6, 8)) -> Group:
    """Channel 0 is what the base predicts, channel 1 what the adapted model does, channel 2 the treated reference."""
    pixels = torch.rand(count, 3, *size, generator=torch.Generator().manual_seed(seed)) + 0.5
    names = [f"{index}.png" for index in range(count)]
    return Group(f"group-{seed}", names, pixels, pixels[:, 0] > 1, reference_target=pixels[0, 2])


def adapted_of(pixel_values):
    return pixel_values[:, 1]


def evaluate(groups, model=adapted_of):
    return evaluate_gift_i(groups, model, lambda pixels: pixels[:, 0], progress=False)


def test_a_group_is_scored_while_the_next_is_predicted(monkeypatch):
    score, predicted = scoring._score_all, [threading.Event() for _ in range(3)]
    calls = iter(predicted)
    done = []

    def model(pixel_values):
        next(calls).set()
        return adapted_of(pixel_values)

    def after_the_next(samples, tasks):
        index = int(samples[0].group_id[-1])
        assert predicted[min(index + 1, 2)].wait(LONG), "its scoring was waited for"
        done.append(index)
        return score(samples, tasks)

    groups = [make_group(seed) for seed in range(3)]
    want = evaluate(groups)
    monkeypatch.setattr(scoring, "_score_all", after_the_next)
    report = evaluate(groups, model)
    assert sorted(done) == [0, 1, 2]
    assert repr(report.rows) == repr(want.rows) and report.gce == want.gce


def test_the_order_in_which_scoring_ends_does_not_matter(monkeypatch):
    score, second = scoring._score_all, threading.Event()

    def first_waits(samples, tasks):
        if samples[0].group_id == "group-0":
            assert second.wait(LONG)
        elif samples[0].group_id == "group-1":
            second.set()
        return score(samples, tasks)

    groups = [make_group(seed, count=2 + seed) for seed in range(4)]
    want = evaluate(groups)
    monkeypatch.setattr(scoring, "_score_all", first_waits)
    assert repr(evaluate(groups).rows) == repr(want.rows)
    assert [row["group_id"] for row in want.rows] == [f"group-{seed}" for seed in range(4) for _ in range(2 + seed)]


def test_rows_have_the_bits_of_scoring_here(monkeypatch):
    """Sums of many pixels are cut by the number of threads, which a thread has as its own."""
    samples = []
    score = scoring._score_all
    monkeypatch.setattr(scoring, "_score_all", lambda s, tasks: samples.append((s, tasks)) or score(s, tasks))
    groups = [make_group(seed, size=(300, 400)) for seed in range(2)]
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        rows = evaluate(groups).rows
        here = [row for s, tasks in samples for _, own in score(s, tasks) for row in own]
    finally:
        torch.set_num_threads(threads)
    assert repr(rows) == repr(here)


def test_few_groups_are_in_memory(monkeypatch):
    score, blocked, begun = scoring._score_all, threading.Event(), []

    def model(pixel_values):
        begun.append(len(begun))
        if len(begun) == scoring.SCORERS + 1:
            threading.Timer(0.2, blocked.set).start()  # what is wrong reads further meanwhile
        return adapted_of(pixel_values)

    def wait(samples, tasks):
        assert blocked.wait(LONG)
        seen.append(len(begun))
        return score(samples, tasks)

    seen = []
    monkeypatch.setattr(scoring, "_score_all", wait)
    evaluate([make_group(seed) for seed in range(8)], model)
    assert seen[0] == scoring.SCORERS + 1


@pytest.mark.parametrize("where", ["scoring", "reading"])
def test_an_error_ends_it(monkeypatch, where):
    def fail(*args):
        raise ValueError("group group-1: broken")

    score = scoring._score_all
    groups = [make_group(seed) for seed in range(6)]
    if where == "scoring":
        monkeypatch.setattr(
            scoring, "_score_all", lambda s, tasks: (fail if s[0].group_id == "group-1" else score)(s, tasks)
        )
    else:
        groups[1].names = groups[1].names[:-1]
    with pytest.raises(ValueError, match=r"group group-1: "):
        evaluate(groups)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("scoring")]


def test_what_one_process_stumbles_over_all_report(tmp_path):
    groups = [make_group(seed) for seed in range(3)]
    groups[1].names = groups[1].names[:-1]

    def start(rank):
        try:
            evaluate_gift_i(groups, adapted_of, lambda pixels: pixels[:, 0], accelerator=Accelerator(cpu=True))
        except ValueError as error:
            (tmp_path / str(rank)).write_text(str(error))

    assert run_in_processes(start) == [0, 0]
    told = [(tmp_path / str(rank)).read_text() for rank in range(2)]
    assert told[0] == told[1] and told[0].startswith("group group-1: ")


def test_both_references_are_one_prediction(prepared):
    dataset = load_gift_i(prepared, "validation")
    model = DepthModel(tiny_model(0), tiny_processor(), SIZE, kind="depth", teacher=tiny_model(1))
    want = {reference: evaluate_gift_i(dataset, model, reference=reference) for reference in REFERENCES}
    forwards = []
    network = model.network.register_forward_hook(lambda *args: forwards.append("network"))
    reports = evaluate_references(dataset, model)
    network.remove()
    assert len(forwards) == len(dataset)  # a batch of two images each
    for reference, report in reports.items():
        assert repr(report.rows) == repr(want[reference].rows) and report.gce == want[reference].gce
        assert report.protocol == want[reference].protocol and report.reference == want[reference].reference
    assert np.isfinite(reports["depth"].summary["tom"]["rmse"])
