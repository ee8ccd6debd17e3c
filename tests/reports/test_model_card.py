"""The card a run writes is a valid one, tells what was measured, and holds no path; the upload gets five files."""

import itertools
import json
import math
import tomllib
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import huggingface_hub
import pytest
import torch
import yaml
from helpers.reports import random_rows, report_of
from helpers.runs import arguments, train_again
from helpers.tiny import write_group, write_raw_tree
from huggingface_hub import DatasetCard, ModelCard
from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

from gift_peft import (
    Metric3DConfig,
    Metric3DForDepthEstimation,
    MogeConfig,
    MogeForDepthEstimation,
    VggtConfig,
    VggtForDepthEstimation,
    get_gift_model,
)
from gift_peft.dataset.writer import write_gift_i
from gift_peft.evaluation.metrics import METRICS
from gift_peft.reports import model_card
from gift_peft.reports.model_card import base_license, find_backbone
from gift_peft.training import loop, start, train, upload
from gift_peft.training.arguments import GiftTrainingArguments

ROOT = Path(__file__).parents[2]
ROW = {"step": 0, "epoch": 0, "val_gce": 0.5} | {
    f"val_{region}_{metric}": 0.25 for region in ("tom", "other", "all") for metric in METRICS
}
RECORD = {
    "model_type": "depth_anything",
    "kind": "inverse_depth",
    "size": [476, 644],
    "num_groups": 12,
    "step": 600,
    "epoch": 50.0,
    "mixed_precision": "bf16",
    "num_processes": 1,
}


def make(tmp_path, adapted, **changes):
    args = GiftTrainingArguments("depth-anything/Depth-Anything-V2-Large-hf", "someone/gift-i", "out", **changes)
    record = upload.run_record(args, **RECORD, metrics={"base": ROW, "adapter": adapted})
    (tmp_path / "README.md").write_text(model_card.model_card(asdict(args), record))
    return ModelCard.load(tmp_path / "README.md")


def test_a_card_without_a_countable_group_has_no_nan(tmp_path):
    """GCE of groups without a pair is NaN: no metric of the card, whose data stay what JSON can hold."""
    rows = random_rows([1, 1])
    report = report_of(rows, gce=dict.fromkeys(("base", "adapted", "base_normalized", "adapted_normalized"), math.nan)
                       | {"num_groups": 0, "num_skipped": 2})  # fmt: skip
    args = GiftTrainingArguments("depth-anything/Depth-Anything-V2-Large-hf", "someone/gift-i", "out")
    record = upload.run_record(args, **RECORD, metrics={"base": ROW | {"val_gce": None}, "adapter": ROW})
    for reports in ([report], []):
        for metrics in (record["metrics"], {"base": ROW, "adapter": ROW | {"val_gce": math.nan}}):
            card = ModelCard(model_card.model_card(asdict(args), record | {"metrics": metrics}, reports))
            json.dumps(card.data.to_dict(), allow_nan=False)
            assert "nan" not in card.content.lower().split() and card.data.eval_results


def test_a_card_asks_for_the_transformers_that_the_package_asks_for():
    dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    least = next(line for line in dependencies if line.startswith("transformers")).partition(">=")[2]
    template = Path(model_card.__file__).parent / "templates" / "model_card.md"
    assert f"`pipeline` and `AutoModel` {least}:" in template.read_text(encoding="utf-8")


def test_metadata_on_the_hub(tmp_path):
    adapted = ROW | {"val_gce": 0.125, "val_tom_rmse": 0.2, "step": 600}
    loaded = make(tmp_path, adapted, hub_model_id="someone/gift-large")
    data = loaded.data
    assert data.library_name == "peft"
    assert data.base_model == "depth-anything/Depth-Anything-V2-Large-hf"
    assert data.to_dict()["base_model_relation"] == "adapter"
    assert (data.pipeline_tag, data.license, data.datasets) == ("depth-estimation", "cc-by-nc-4.0", ["someone/gift-i"])
    results = {result.metric_type: result.metric_value for result in data.eval_results}
    assert (results["gce"], results["tom_rmse"], results["other_rmse"]) == (0.125, 0.2, 0.25)
    assert data.model_name == "gift-large"
    assert 'model="someone/gift-large"' in loaded.text
    assert "| GCE ↓ | 0.50000 | 0.12500 | -75.0 % |" in loaded.text
    assert "larger is nearer" in loaded.text


def test_a_licence_may_be_stated(tmp_path):
    assert make(tmp_path, ROW, license="mit").data.license == "mit"
    assert base_license("someone/unknown") == "other"
    (tmp_path / "README.md").write_text("---\nlicense: bsd-2-clause\n---\n")
    assert base_license(str(tmp_path)) == "bsd-2-clause"
    for broken in (b"---\nlicense: [a\n: b\n---\n", b"---\nlicense: \xff\n---\n"):
        (tmp_path / "README.md").write_bytes(broken)
        assert base_license(str(tmp_path)) == "other"


def test_without_validation_nothing_is_claimed(tmp_path):
    loaded = make(tmp_path, {key: None if key.startswith("val") else value for key, value in ROW.items()})
    assert loaded.data.eval_results is None
    assert "nothing was measured" in loaded.text


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return write_raw_tree(tmp_path_factory.mktemp("tree") / "raw")


def test_a_runs_card_parses_and_names_no_path(base_dir, tree, tmp_path):
    result = train(arguments(base_dir, tree, tmp_path / "out", max_steps=2))
    for name in ("adapter", "adapter-last"):
        folder = tmp_path / "out" / name
        loaded = ModelCard.load(folder / "README.md")
        measured = {r.metric_type: r.metric_value for r in loaded.data.eval_results}
        assert measured["gce"] == pytest.approx(result.metrics[1]["val_gce"], abs=1e-6)
        assert loaded.data.base_model is None
        for file in ("README.md", "gift.json"):
            text = (folder / file).read_text()
            assert str(base_dir) not in text and str(tmp_path) not in text and str(tree) not in text
        gift = json.loads((folder / "gift.json").read_text())
        assert gift["arguments"]["learning_rate"] == 2e-4
        assert gift["arguments"]["dataset_name"] == "raw"
        assert {"torch", "peft", "transformers", "gift-peft"} <= gift["versions"].keys()
        for version in ("torch", "peft", "transformers"):
            assert f"{version} {gift['versions'][version]}" in loaded.text


class HubStandIn:
    """What `push` uses of HfApi; remembers the calls."""

    calls: list

    def create_repo(self, repo_id, **options):
        self.calls.append(("create_repo", repo_id, options))
        return SimpleNamespace(repo_id=f"me/{repo_id}" if "/" not in repo_id else repo_id)

    def upload_folder(self, *, repo_id, folder_path, allow_patterns, **options):
        names = {path.name for path in folder_path.iterdir()}
        self.calls.append(("upload_folder", repo_id, sorted(names & set(allow_patterns))))


@pytest.fixture
def hub(monkeypatch):
    """Calls to a hub that takes a run whose base is a folder, which `check_push` would refuse."""
    calls = []
    monkeypatch.setattr(HubStandIn, "calls", calls, raising=False)
    monkeypatch.setattr(huggingface_hub, "HfApi", HubStandIn)
    monkeypatch.setattr(start, "check_push", lambda args: None)
    return calls


@pytest.mark.parametrize(("name", "repository"), [(None, "me/out"), ("lab/gift", "lab/gift")])
def test_push_uploads_the_adapter_and_nothing_else(name, repository, hub, base_dir, tree, tmp_path, capsys):
    args = arguments(base_dir, tree, tmp_path / "out", max_steps=1, push_to_hub=True, hub_model_id=name)
    args.hub_private_repo = True
    train(args)
    files = ["README.md", "adapter_config.json", "adapter_model.safetensors", "gift.json", "preprocessor_config.json"]
    assert hub == [
        ("create_repo", name or "out", {"private": True, "exist_ok": True}),
        ("upload_folder", repository, files),
    ]
    assert f"https://huggingface.co/{repository}" in capsys.readouterr().out


def test_a_failed_upload_leaves_the_adapter_and_can_be_repeated(hub, base_dir, tree, tmp_path, monkeypatch):
    def refuse(self, *args, **kwargs):
        raise OSError("the hub is away")

    args = arguments(base_dir, tree, tmp_path / "out", max_steps=1, push_to_hub=True)
    with monkeypatch.context() as patch:
        patch.setattr(HubStandIn, "upload_folder", refuse)
        with pytest.raises(OSError, match=r"push_to_hub: .*the hub is away.*resume_from_checkpoint latest"):
            train(args)
    assert (tmp_path / "out/adapter-last/adapter_model.safetensors").exists()
    train_again(args)
    assert hub[-1][0] == "upload_folder"


def test_push_is_checked_before_anything_is_loaded(base_dir, tree, tmp_path, monkeypatch):
    def never(*args):
        raise AssertionError("training had begun")

    monkeypatch.setattr(loop, "load_base", never)
    monkeypatch.setattr(huggingface_hub, "get_token", lambda: None)
    with pytest.raises(ValueError, match="push_to_hub: no token; run `hf auth login` or set HF_TOKEN"):
        train(GiftTrainingArguments("some/base", str(tree), str(tmp_path / "out"), push_to_hub=True))
    with pytest.raises(ValueError, match="push_to_hub: model_name_or_path is a local folder"):
        train(arguments(base_dir, tree, tmp_path / "out", push_to_hub=True))
    monkeypatch.setattr(huggingface_hub, "get_token", lambda: "token")
    with pytest.raises(ValueError, match=r"push_to_hub: .*'a/b/c'.*hub_model_id"):
        train(GiftTrainingArguments("some/base", "d", str(tmp_path / "out"), push_to_hub=True, hub_model_id="a/b/c"))
    assert not (tmp_path / "out").exists()


# ---- evaluations, backbones, data sets ----


def test_every_evaluation_keeps_its_own_metrics(tmp_path):
    """Without a config the Hub's client would merge the metrics of two evaluations on one dataset."""
    rows = random_rows([2, 3])
    proxy = report_of(rows)
    depth = report_of(random_rows([2, 3], seed=1), reference="depth", unit="mm")
    booster = report_of(random_rows([2, 3], seed=2), booster=True)
    args = GiftTrainingArguments("depth-anything/Depth-Anything-V2-Large-hf", "someone/gift-i", "out")
    record = upload.run_record(args, **RECORD, metrics={"base": ROW, "adapter": ROW})
    loaded = ModelCard(model_card.model_card(asdict(args), record, [proxy, depth, booster]))
    found = {}
    for result in loaded.data.eval_results:
        found.setdefault((result.dataset_type, result.dataset_config), {})[result.metric_type] = result.metric_value
    assert list(found) == [
        ("someone/gift-i", "against the treated-reference proxy, protocol native"),
        ("someone/gift-i", "against true depth, protocol native"),
        ("booster", "balanced, protocol gift"),
    ]
    for values, report in zip(found.values(), (proxy, depth, booster), strict=True):
        assert values["tom_rmse"] == pytest.approx(report.summary["tom"]["rmse"], abs=1e-6)
        assert ("gce" in values) == (report is not booster) and len(values) == 12 + (report is not booster)
    assert loaded.text.count("95 % bootstrap intervals") == 3
    for where in ("GIFT-I, proxy", "GIFT-I, depth", "Booster"):
        assert f"| {where}: RMSE ↓ |" in loaded.text


def test_what_got_worse_stands_under_limits():
    args = GiftTrainingArguments("depth-anything/Depth-Anything-V2-Large-hf", "someone/gift-i", "out")
    adapted = ROW | {"val_tom_rmse": 0.2, "val_other_rmse": 0.3}
    record = upload.run_record(args, **RECORD, metrics={"base": ROW, "adapter": adapted})
    limits = model_card.model_card(asdict(args), record).split("## Limits")[1]
    assert "Other RMSE on the validation groups got worse, by 20.0 %" in limits and "ToM RMSE" not in limits
    report = report_of(random_rows([2, 3]), collapse={"target_mean_ratio": 0.1, "spread_ratio": 1.0, "alarm": True})
    assert "Collapse alarm on GIFT-I (proxy)" in model_card.model_card(asdict(args), record, [report])


@pytest.mark.parametrize("name", ["facebook/VGGT-1B", "depth-anything/Depth-Anything-V2-Small-hf", "base", "a/b/c"])
@pytest.mark.parametrize("trained", [False, True])
@pytest.mark.parametrize("reports", [[], [random_rows([2, 3])]], ids=["run", "evaluation"])
def test_nothing_of_the_template_is_left(name, trained, reports):
    args = GiftTrainingArguments(name, "someone/gift-i", "out")
    metrics = {"base": ROW, "adapter": ROW | {"val_other_rmse": 0.3}}
    record = upload.run_record(args, **RECORD, metrics=metrics, dataset_fingerprint="abc-1") if trained else None
    text = model_card.model_card(asdict(args), record, [report_of(rows) for rows in reports])
    assert not any(mark in text for mark in ("{{", "}}", "{%", "%}", "{#", "None", "Undefined", "\n\n\n"))
    assert text.endswith(".\n") and not any(line.startswith(" |") for line in text.splitlines())
    for before, after in itertools.pairwise(text.splitlines()):  # headings and tables need an empty line before them
        assert not (after.startswith(("## ", "|---")) and before and not before.startswith("|")), (before, after)


CARDS = {
    "depth_anything_v2_large": ("depth-anything/Depth-Anything-V2-Large-hf", "cc-by-nc-4.0", "335,315,649"),
    "vggt_1b": ("facebook/VGGT-1B", "cc-by-nc-4.0", "941,766,882"),
    "metric3d_v2_giant": ("JUGGHM/Metric3D", "unknown", "1,377,675,099"),
    "moge_2_large": ("Ruicheng/moge-2-vitl-normal", "mit", "330,901,544"),
}


@pytest.mark.parametrize("name", CARDS)
def test_cards_of_backbones_are_what_the_generator_writes(name):
    arguments = yaml.safe_load((ROOT / "examples" / f"{name}.yaml").read_text())
    text = (ROOT / "model_cards" / f"{name}.md").read_text()
    assert text == model_card.model_card(arguments)
    loaded = ModelCard(text)
    base, license, parameters = CARDS[name]
    data = loaded.data.to_dict()
    assert (data["base_model"], data["license"], data["library_name"]) == (base, license, "peft")
    assert (data["base_model_relation"], data["pipeline_tag"]) == ("adapter", "depth-estimation")
    assert "model-index" not in data and loaded.text.lower().count("not trained yet") == 2 and parameters in text
    table = loaded.text.split("## What the paper reports")[1].split("##")[0]
    assert table.count("\n|") == 6 and "| paper |" in table and "nothing in this table was run here" in table


def depth_anything_v2_large():
    backbone = Dinov2Config(
        hidden_size=1024,
        num_hidden_layers=24,
        num_attention_heads=16,
        image_size=518,
        patch_size=14,
        out_indices=[5, 12, 18, 24],
        reshape_hidden_states=False,
        apply_layernorm=True,
    )
    neck = {"reassemble_hidden_size": 1024, "neck_hidden_sizes": [256, 512, 1024, 1024], "fusion_hidden_size": 256}
    return DepthAnythingForDepthEstimation(DepthAnythingConfig(backbone_config=backbone, head_hidden_size=32, **neck))


def moge_2_large():
    pytest.importorskip("moge.model.v2", reason="MoGe (dlr-moge) is not installed")
    return MogeForDepthEstimation(MogeConfig())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "build"),
    [
        ("depth-anything/Depth-Anything-V2-Large-hf", depth_anything_v2_large),
        ("facebook/VGGT-1B", lambda: VggtForDepthEstimation(VggtConfig())),
        ("JUGGHM/Metric3D", lambda: Metric3DForDepthEstimation(Metric3DConfig())),
        ("Ruicheng/moge-2-vitl-normal", moge_2_large),
    ],
)
@pytest.mark.parametrize("head", ["full", "lora", "none"])
def test_sizes_on_the_card_are_those_of_the_adapter(name, build, head):
    backbone = find_backbone(name)
    with torch.device("meta"):
        model = build()
        assert sum(weight.numel() for weight in model.parameters()) == backbone.parameters
        model = get_gift_model(model, rank=4, head=head)
    trained = [(name, weight.numel()) for name, weight in model.named_parameters() if weight.requires_grad]
    lora = sum(count for name, count in trained if "lora_" in name)
    assert backbone.adapter_sizes(4)[head] == (lora, sum(count for _, count in trained) - lora)
    assert model.config.model_type == backbone.model_type


def test_a_trained_folder_is_not_taken_for_the_backbone_it_is_named_after(base_dir, tree, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "vggt-1b").mkdir()
    args = GiftTrainingArguments("vggt-1b", "someone/gift-i", "out")
    record = upload.run_record(args, **RECORD, metrics={"base": ROW, "adapter": ROW})
    loaded = ModelCard(model_card.model_card(asdict(args), record))
    assert loaded.data.base_model is None and "paper" not in loaded.text
    with pytest.raises(ValueError, match="needs model_name_or_path"):
        model_card.model_card({})


def test_the_dataset_card_is_valid(tmp_path):
    group = write_group(tmp_path / "group", 2, 0)
    row = {"split": "train", "group_id": "g", "images": sorted(group.glob("*.png"))}
    row["masks"] = sorted((group / "masks").glob("*.png"))
    folder = write_gift_i([row], tmp_path / "gift-i", license="cc-by-4.0", pretty_name="My: mirrors")
    for path in (folder / "README.md", ROOT / "src/gift_peft/demo/gift-i/README.md"):
        data = DatasetCard.load(path).data
        assert data.task_categories == ["depth-estimation"] and data.license and data.pretty_name
        assert data.to_dict()["configs"][0]["data_files"]
    assert DatasetCard.load(folder / "README.md").data.pretty_name == "My: mirrors"


def test_the_templates_are_part_of_the_wheel():
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    folder = ROOT / "src" / "gift_peft" / "reports"
    packed = {path for pattern in patterns["gift_peft.reports"] for path in folder.glob(pattern)}
    assert len(packed) == 6 and packed == {path for path in folder.rglob("*.*") if path.suffix in (".md", ".html")}
