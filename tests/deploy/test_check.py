"""The checker that travels with an export: what it says of right and of wrong outputs."""

import json

import numpy as np
import pytest

from gift_peft.deploy import check

SHAPES = [(1, 56, 70), (2, 28, 42), (1, 84, 42)]


@pytest.fixture
def reference():
    rng = np.random.default_rng(0)
    pairs = {f"output_{index}": rng.normal(5, 1, shape).astype(np.float32) for index, shape in enumerate(SHAPES)}
    inputs = {f"input_{i}": rng.normal(size=(b, 3, h, w)).astype(np.float32) for i, (b, h, w) in enumerate(SHAPES)}
    return pairs | inputs | {"tolerance": np.array(1e-5), "model_id": np.array("a")}


def said(reference, change):
    outputs = [reference[f"output_{index}"].copy() for index in range(3)]
    outputs[0] = change(outputs[0])
    (worst, text), *others = check.differences(reference, outputs)
    assert all(value == 0 for value, _ in others)
    return worst, text


def test_right_outputs(reference):
    assert said(reference, lambda x: x) == (
        0,
        "largest difference 0.0e+00 of the mean at picture 0, row 0, column 0, on average 0.0e+00",
    )
    assert said(reference, lambda x: x[:, None])[0] == 0  # a channel of one
    worst, text = said(reference, lambda x: x + 5e-5 * (np.arange(70) == 9))
    assert 0.9e-5 < worst < 1.1e-5 and "column 9" in text


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x: x * 0, "all zero"),
        (lambda x: np.full_like(x, 3), "the same number everywhere"),
        (lambda x: x[:, ::-1], "upside down"),
        (lambda x: x[..., ::-1], "mirrored"),
        (lambda x: x * 1.7, "the reference times 1.7"),
        (lambda x: x.astype(np.float16).astype(np.float32), "16-bit"),
        (lambda x: x.transpose(0, 2, 1), "shape 1x70x56 in place of 1x56x70"),
        (lambda x: np.where(np.arange(70) == 4, np.nan, x), "56 of 3920 values are NaN or infinite"),
        (lambda x: None, "no output"),
        (lambda x: x + (np.arange(70) > 59), "columns 60-69"),
    ],
)
def test_it_says_what_is_wrong(reference, change, words):
    worst, text = said(reference, change)
    assert worst > 1e-5 and words in text


def test_a_graph_of_one_size_is_recognized(reference):
    outputs = [np.ones((1, 56, 70), np.float32)] * 3
    found = check.differences(reference, outputs)
    assert "keeps the size it was traced at" in found[1][1] and found[1][0] == np.inf


def test_outputs_in_another_order_are_recognized():
    reference = {f"output_{index}": np.random.default_rng(index).normal(5, 1, (1, 8, 8)) for index in range(2)}
    (_, text), _ = check.differences(reference, [reference["output_1"], reference["output_0"]])
    assert "it is the reference of pair 1" in text


# ---- the command ----


@pytest.fixture
def here(reference, tmp_path, monkeypatch):
    np.savez(tmp_path / "reference.npz", **reference)
    monkeypatch.setattr(check, "__file__", str(tmp_path / "check.py"))
    return tmp_path


def test_stored_outputs_of_other_runtimes(here, reference, capsys):
    (here / "outputs").mkdir()
    for index, shape in enumerate(SHAPES):  # as `trtexec --exportOutput` writes them
        values = reference[f"output_{index}"]
        entry = {"name": "predicted_depth", "dimensions": "x".join(map(str, shape)), "values": values.ravel().tolist()}
        (here / "outputs" / f"output_{index}.json").write_text(json.dumps([entry]))
    assert check.main([str(here / "outputs")]) == 0
    np.save(here / "outputs" / "output_1.npy", reference["output_1"] * 2)  # is read before the JSON
    assert check.main([str(here / "outputs")]) == 1
    said = capsys.readouterr().out
    assert "pair 1 (2x3x28x42): WRONG" in said and "times 2" in said and "1 of 3 pairs are wrong" in said
    np.savez(here / "all.npz", **{f"output_{index}": reference[f"output_{index}"] + 1e-3 for index in range(3)})
    assert check.main([str(here / "all.npz")]) == 1
    assert check.main([str(here / "all.npz"), "--tolerance", "1e-3"]) == 0


def test_inputs_for_other_runtimes(here, reference):
    assert check.main(["--write-inputs", str(here / "inputs")]) == 0
    raw = np.frombuffer((here / "inputs" / "input_1.bin").read_bytes(), np.float32).reshape(2, 3, 28, 42)
    assert np.array_equal(raw, reference["input_1"]) and np.array_equal(raw, np.load(here / "inputs" / "input_1.npy"))


def test_bad_input_is_one_line(here, capsys):
    (here / "outputs").mkdir()
    (here / "outputs" / "output_0.json").write_text("[]")
    for source in (here / "none", here / "outputs", here / "check.txt"):
        if source.name == "check.txt":
            source.write_text("x")
        assert check.main([str(source)]) == 1
    said = capsys.readouterr()
    assert "no such file" in said.err and "not what `trtexec" in said.err and "Traceback" not in said.err
    (here / "reference.npz").unlink()
    assert check.main([]) == 1 and "reference.npz" in capsys.readouterr().err
