"""LayeredDepth and MD-3k: hand-worked cases, straight-line evaluators, trees of each layout and of others."""

import json
import math

import numpy as np
import pytest
import torch
from helpers.orderings import write_layered, write_md3k
from helpers.tiny import tiny_model, tiny_processor, write_base
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from gift_peft import evaluate_layered_depth, evaluate_md3k, get_gift_model, save_adapter, set_adapter_scale
from gift_peft.adapters.scale import active_lora, adapter_scale
from gift_peft.cli import main
from gift_peft.evaluation.orderings import OrderingReport, count_right
from gift_peft.models.loading import DepthModel

DEPTH = np.array([[1.0, 2.0, 3.0], [3.0, 3.0, 0.5]])  # H 2, W 3

pytestmark = [
    pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning"),
    pytest.mark.filterwarnings("ignore:the base is the local folder"),
]


# ---- the definition ----


def test_a_question_worked_by_hand():
    pairs = np.array([[[0, 0], [1, 0]], [[1, 0], [0, 0]], [[2, 0], [0, 1]], [[0, 0], [3, 0]], [[-1, 0], [0, 0]]])
    # 1 < 2 right; 2 < 1 wrong; 3 < 3 is no growth; x = 3 and x = -1 lie outside
    assert count_right(DEPTH, pairs) == (1, 3, 2)
    assert count_right(1 / DEPTH, pairs, "inverse_depth") == (1, 3, 2)
    triplets = np.array([[[2, 1], [0, 0], [2, 0]], [[0, 0], [2, 0], [1, 0]], [[0, 0], [1, 0], [1, 9]]])
    assert count_right(torch.tensor(DEPTH), triplets) == (1, 2, 1)
    assert count_right(DEPTH, np.array([[[0.9, 0.9], [1.9, 0.2]]])) == (1, 1, 0)  # cut to whole pixels: 1 < 2
    assert count_right(DEPTH, np.zeros((0, 2, 2))) == (0, 0, 0)
    for depth, kind, match in ((DEPTH, "disparity", "unknown kind"), (DEPTH[None], "depth", r"must be \(H, W\)")):
        with pytest.raises(ValueError, match=match):
            count_right(depth, pairs, kind)
    with pytest.raises(ValueError, match="NaN"):
        count_right(np.full((2, 3), np.nan), pairs)


def straight_line(depth, questions):
    """The benchmark's definition, point by point."""
    right = counted = outside = 0
    for question in questions:
        points = [(int(x), int(y)) for x, y in question]
        if any(not (0 <= x < depth.shape[1] and 0 <= y < depth.shape[0]) for x, y in points):
            outside += 1
            continue
        counted += 1
        last = -math.inf
        for x, y in points:
            if not depth[y, x] > last:
                break
            last = depth[y, x]
        else:
            right += 1
    return right, counted, outside


@given(st.integers(0, 2**32 - 1), st.integers(2, 4))
def test_counts_are_those_of_straight_line_code_whatever_increasing_map(seed, length):
    rng = np.random.default_rng(seed)
    depth = rng.integers(1, 6, (7, 9)).astype(float)  # ties are common
    questions = rng.uniform(-1, 10, (40, length, 2))
    expected = straight_line(depth, questions)
    assert count_right(depth, questions) == expected
    assert count_right(3 * depth**2 + 5, questions) == expected  # nothing has to be aligned
    assert count_right(10 - depth, questions, "inverse_depth") == expected


# ---- LayeredDepth ----


def test_layered_depth_of_stored_predictions(tmp_path):
    tuples = write_layered(tmp_path / "data")
    rng = np.random.default_rng(1)
    stored = tmp_path / "stored"
    stored.mkdir()
    maps = {index: rng.integers(1, 60000, (24, 32)).astype(np.uint16) for index in (0, 3, 11)}
    Image.fromarray(maps[0]).save(stored / "0_1.png")  # as the benchmark's own evaluator takes it
    np.save(stored / "3.npy", maps[3].astype(np.float32))
    Image.fromarray(maps[11]).save(stored / "11.png")
    report = evaluate_layered_depth(tmp_path / "data", predictions=stored, kind="depth", progress=False)
    assert not report.adapted and report.base is None and report.counts["photos"] == 3
    for subset, own in tuples.items():
        counts = [straight_line(maps[index].astype(float), questions) for index, questions in own.items()]
        right, counted, outside = map(sum, zip(*counts, strict=True))
        assert report.summary[subset] == pytest.approx(right / counted, abs=1e-12)
        assert report.counts["questions"][subset] == counted and report.counts["outside"][subset] == outside > 0
    np.save(stored / "3.npy", np.full((24, 32), np.nan, np.float32))
    with pytest.raises(ValueError, match=r"3\.npy: the prediction has 768 NaN"):
        evaluate_layered_depth(tmp_path / "data", predictions=stored, kind="depth", progress=False)
    (stored / "11.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"1 missing .*: 11$"):
        evaluate_layered_depth(tmp_path / "data", predictions=stored, kind="depth", progress=False)
    with pytest.raises(ValueError, match="say what the predictions are"):
        evaluate_layered_depth(tmp_path / "data", predictions=stored, progress=False)


def test_layered_depth_of_a_model_is_that_of_its_written_depth(tmp_path):
    write_layered(tmp_path / "data", photos=".", size=(40, 56))
    model = DepthModel(tiny_model(), tiny_processor(), size="56x70")
    stored = tmp_path / "stored"
    stored.mkdir()
    for index in (0, 3, 11):
        np.save(stored / f"{index}.npy", model.depth_at(tmp_path / "data" / f"{index}.png"))
    own = evaluate_layered_depth(tmp_path / "data", model, progress=False)
    theirs = evaluate_layered_depth(tmp_path / "data", predictions=stored, kind="inverse_depth", progress=False)
    assert own.summary == theirs.summary and own.counts == theirs.counts and 0 < own.summary["pairs"] < 1
    turned = evaluate_layered_depth(tmp_path / "data", predictions=stored, kind="depth", progress=False)
    assert turned.summary["pairs"] == pytest.approx(1 - own.summary["pairs"], abs=0.05)  # (points that coincide)


def test_other_trees_are_named(tmp_path):
    def refused(root, error, match, **options):
        with pytest.raises(error, match=match):
            evaluate_layered_depth(root, predictions=tmp_path, kind="depth", progress=False, **options)

    refused(tmp_path / "nowhere", FileNotFoundError, "no such folder")
    (tmp_path / "pairs_val").mkdir()
    refused(tmp_path, FileNotFoundError, r"no first layer; .* \(pairs_val holds tuples of all layers\)")
    write_layered(tmp_path / "data")
    refused(tmp_path, FileNotFoundError, r"no first layer; .*; name .*data$")
    root = tmp_path / "data"
    (root / "images" / "3.png").rename(root / "images" / "4.png")
    refused(root, FileNotFoundError, r"1 of 3 photos are missing in .*images, the first is 3\.png")
    (root / "images" / "4.png").rename(root / "images" / "3.png")
    for path in (root / "images").iterdir():
        Image.open(path).save(root / path.name)
    refused(root, ValueError, "all hold photos of these names")
    for path in root.glob("*.png"):
        path.unlink()
    (root / "triplets_layer1_val").rename(tmp_path / "away")
    refused(root, FileNotFoundError, r"triplets_layer1_val is missing \(partial=True")
    refused(root, FileNotFoundError, "3 missing", partial=True)
    lines = root / "pairs_layer1_val" / "3.jsonl"
    for text, match in (
        ("[[1, 2, 1]]", r"3\.jsonl, line 2: 2 points \[x, y, layer\] are expected"),
        ('{"x": 1}', r"line 2: not a list"),
        ("[[1, 2, 1], [NaN, 2, 1]]", r"line 2: a coordinate is not a finite number"),
        ("[[1, 2, 1], [3, 4", r"line 2: not a list"),
    ):
        lines.write_text(f"[[1, 2, 1], [3, 4, 1]]\n{text}\n")
        refused(root, ValueError, match, partial=True)


# ---- MD-3k ----


def pair(point1, point2, first, second):
    subset = "same" if first == second else "reverse"
    labels = {"foreground_label": first, "background_label": second, "subset": subset}
    return {"point1": point1, "point2": point2, **labels}


def test_md3k_worked_by_hand(tmp_path):
    (tmp_path / "images").mkdir()
    Image.new("RGB", (3, 2)).save(tmp_path / "images" / "a.png")
    pairs = [
        pair([0, 0], [1, 0], "near", "near"),  # 1 < 2: right on both layers
        pair([0, 0], [2, 0], "far", "near"),  # 1 < 3: right behind
        pair([2, 0], [1, 0], "far", "near"),  # 3 > 2: right on the glass
        pair([2, 1], [0, 0], "far", "near"),  # 0.5 < 1: right behind
        pair([2, 0], [0, 1], "near", "far"),  # 3 = 3: wrong on both
        pair([0, 0], [0, 7], "near", "near"),  # outside
    ]
    (tmp_path / "annotations.json").write_text(json.dumps({"./images/a.png": pairs}))
    (tmp_path / "stored" / "images").mkdir(parents=True)
    np.save(tmp_path / "stored" / "images" / "a.npy", DEPTH)
    report = evaluate_md3k(tmp_path, predictions=tmp_path / "stored", kind="depth", progress=False)
    expected = {"sra1": 2 / 5, "sra2": 3 / 5, "alpha": 1 / 5, "same_sra1": 1, "same_sra2": 1, "same_alpha": 0}
    expected |= {"reverse_sra1": 1 / 4, "reverse_sra2": 2 / 4, "reverse_alpha": 1 / 4}
    assert report.summary == pytest.approx(expected, abs=1e-12)
    assert report.counts["questions"]["sra1"] == 5 and report.counts["outside"]["sra2"] == 1


def test_md3k_of_an_adapter_and_its_dial(tmp_path, capsys):
    base, adapter = write_base(tmp_path / "base"), tmp_path / "adapter"
    content = write_md3k(tmp_path / "md3k", size=(56, 70))
    model = get_gift_model(tiny_model(), rank=2)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if weight.requires_grad:
                generator = torch.Generator().manual_seed(len(name))
                weight.add_(0.2 * torch.randn(weight.shape, generator=generator))
    save_adapter(model, adapter, str(base), processor=tiny_processor(), size=(56, 70))
    options = ["--base", base, "--adapter", adapter, "--out", tmp_path / "out"]
    with pytest.raises(SystemExit, match="0"):
        main([str(word) for word in ["evaluate", "--md3k", tmp_path / "md3k", *options, "--dial", -1, 0, 0.5, 1]])
    printed = capsys.readouterr().out
    assert "Layer dial" in printed and "toward what lies behind" in printed and "GDD" in printed
    values = json.loads((tmp_path / "out" / "metrics.json").read_text())
    report = OrderingReport.from_dict(values)
    assert [entry["scale"] for entry in report.dial] == [-1, 0, 0.5, 1] and report.adapted
    for scale, wanted in ((0, report.base), (1, report.summary)):
        entry = next(entry for entry in report.dial if entry["scale"] == scale)
        assert {key: entry[key] for key in wanted} == wanted
    loaded = DepthModel.from_pretrained(base, adapter)
    for entry in report.dial:
        set_adapter_scale(loaded.network, entry["scale"])
        right = total = 0
        for name, pairs in content.items():
            depth = -loaded.depth_at(tmp_path / "md3k" / name)  # inverse depth: larger is nearer
            for item in pairs:
                (x1, y1), (x2, y2) = item["point1"], item["point2"]
                nearer = depth[y1, x1] < depth[y2, x2] if item["foreground_label"] == "near" else None
                right += depth[y1, x1] > depth[y2, x2] if nearer is None else nearer
                total += 1
        assert entry["sra1"] == pytest.approx(right / total, abs=1e-9)
    set_adapter_scale(loaded.network, 0.5)
    evaluate_md3k(tmp_path / "md3k", loaded, dial=[-1], progress=False)
    before = loaded.depth_at(tmp_path / "md3k" / "images" / "0.png")
    set_adapter_scale(loaded.network, 0.5)
    assert np.array_equal(loaded.depth_at(tmp_path / "md3k" / "images" / "0.png"), before)  # its own scale again
    with pytest.raises(ValueError, match="the layer dial turns an adapter"):
        evaluate_md3k(tmp_path / "md3k", DepthModel.from_pretrained(base), dial=[0], progress=False)
    with pytest.raises(ValueError, match="scales are finite numbers"):
        evaluate_md3k(tmp_path / "md3k", loaded, dial=[math.nan], progress=False)


def test_a_dial_that_stops_leaves_the_adapter_as_it_was(tmp_path, monkeypatch):
    write_md3k(tmp_path / "md3k", size=(56, 70))
    network = get_gift_model(tiny_model(), rank=6, head="lora")
    set_adapter_scale(network, 0.3)
    scalings = [layer.scaling[name] for layer, name in active_lora(network)]
    model = DepthModel(network, tiny_processor(), size="56x70")
    depth_at = DepthModel.depth_at

    def failing(self, *args, **options):
        if adapter_scale(self.network) < 0:
            raise ValueError("a photo that cannot be read")
        return depth_at(self, *args, **options)

    monkeypatch.setattr(DepthModel, "depth_at", failing)
    with pytest.raises(ValueError, match="cannot be read"):
        evaluate_md3k(tmp_path / "md3k", model, dial=[1, -1], progress=False)
    assert [layer.scaling[name] for layer, name in active_lora(network)] == scalings
    network.merge_adapter()
    with pytest.raises(ValueError, match="the adapter is merged into the base"):
        evaluate_md3k(tmp_path / "md3k", model, dial=[0], progress=False)
    assert all(layer.merged for layer, _ in active_lora(network)), "refused before its base was predicted"


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"foreground_label": "left"}, r"images/a\.png, pair 1: foreground_label is 'left'; it is one of near, far"),
        ({"subset": "other"}, "subset is 'other'"),
        ({"point1": [1]}, r"point1 and point2 are \[x, y\]"),
        ({"point2": [1, float("nan")]}, r"point1 and point2 are \[x, y\]"),
        (None, r"are expected \(a single `label` does not say which layer it means\)"),
    ],
)
def test_annotations_of_another_schema_are_named(tmp_path, change, match):
    Image.new("RGB", (3, 2)).save(tmp_path / "a.png")
    entry = {"point1": [0, 0], "point2": [1, 0], "label": 1} if change is None else pair([0, 0], [1, 0], "near", "far")
    (tmp_path / "annotations.json").write_text(json.dumps({"images/a.png": [entry | (change or {})]}))
    with pytest.raises(ValueError, match=match):
        evaluate_md3k(tmp_path, predictions=tmp_path, kind="depth", progress=False)


def test_files_that_begin_with_a_byte_order_mark(tmp_path):
    Image.new("RGB", (3, 2)).save(tmp_path / "a.png")
    text = json.dumps({"a.png": [pair([0, 0], [1, 0], "near", "near")]})
    (tmp_path / "annotations.json").write_text(text, encoding="utf-8-sig")
    np.save(tmp_path / "a.npy", DEPTH)
    assert evaluate_md3k(tmp_path, predictions=tmp_path, kind="depth", progress=False).summary["sra1"] == 1
    (tmp_path / "pairs_layer1_val").mkdir()
    lines = tmp_path / "pairs_layer1_val" / "a.jsonl"
    lines.write_text("[[0, 0, 1], [1, 0, 1]]\n\n", encoding="utf-8-sig")
    options = {"predictions": tmp_path, "kind": "depth", "partial": True, "progress": False}
    assert evaluate_layered_depth(tmp_path, **options).summary["pairs"] == 1


@pytest.mark.parametrize("options", [["--protocol", "gift"], ["--prediction-scale", "2"]])
def test_what_aligns_depth_is_no_option_of_an_order(options, tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["evaluate", "--md3k", str(tmp_path), "--base", str(tmp_path), *options])
    assert "ask for an order alone" in capsys.readouterr().err


def test_roots_without_md3k_are_named(tmp_path):
    def refused(error, match):
        with pytest.raises(error, match=match):
            evaluate_md3k(tmp_path, predictions=tmp_path, kind="depth", progress=False)

    refused(FileNotFoundError, "annotations.json is missing")
    for text, match in (("[]", "an object is expected"), ("{", "damaged"), ('{"../a.png": []}', "leaves the root")):
        (tmp_path / "annotations.json").write_text(text)
        refused(ValueError, match)
    (tmp_path / "annotations.json").write_text('{"images/a.png": []}')
    refused(FileNotFoundError, r"1 photos are missing, the first is .*images/a\.png")
