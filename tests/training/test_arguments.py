"""YAML, then the command line; every wrong argument is one line that names it."""

from pathlib import Path

import pytest
import yaml

from gift_peft.training.arguments import GiftTrainingArguments, parse_arguments

REQUIRED = ["--model_name_or_path", "m", "--dataset_name", "d", "--output_dir", "o"]


def write(path, text):
    path.write_bytes(text.encode(errors="surrogateescape"))
    return ["--config", str(path)]


@pytest.mark.parametrize(
    ("words", "value"), [([], None), (["--channels_last"], True), (["--channels-last=no"], False)]
)
def test_channels_last_is_a_flag_with_a_third_state(words, value):
    given = ["--model_name_or_path=b", "--dataset_name=d", "--output_dir=o"]
    assert parse_arguments([*given, *words]).channels_last is value


def test_defaults_are_the_papers():
    args = parse_arguments(REQUIRED)
    assert (args.learning_rate, args.weight_decay, args.num_train_epochs) == (2e-5, 0, 50)
    assert (args.lambda_c, args.lambda_d, args.lora_rank, args.head) == (1, 1, 8, "full")
    assert args.micro_batch_size == "auto"  # the paper's 2 has the same gradient


def test_the_command_line_wins_over_yaml_wins_over_defaults(tmp_path):
    config = write(tmp_path / "c.yaml", "learning_rate: 1e-3\nlora_rank: 4\ncheckpoint_at_steps: [3, 5]\nseed: 7\n")
    args = parse_arguments([*config, *REQUIRED, "--seed", "9"])
    assert (args.learning_rate, args.lora_rank, args.checkpoint_at_steps, args.seed) == (1e-3, 4, [3, 5], 9)


def test_required_values_may_come_from_yaml(tmp_path):
    config = write(tmp_path / "c.yaml", "model_name_or_path: m\ndataset_name: d\noverwrite_output_dir: true\n")
    args = parse_arguments([*config, "--output_dir", "o"])
    assert (args.model_name_or_path, args.overwrite_output_dir) == ("m", True)


def test_yamls_bare_no_is_the_word(tmp_path):
    config = write(tmp_path / "c.yaml", "mixed_precision: no\npush_to_hub: no\n")
    args = parse_arguments([*config, *REQUIRED])
    assert (args.mixed_precision, args.push_to_hub) == ("no", False)


@pytest.mark.parametrize(
    ("text", "word"),
    [("true", "latest"), ("True", "latest"), ("false", None), ("null", None), ("run/checkpoint-3",) * 2],
)
def test_resuming_as_transformers_has_it(tmp_path, text, word):
    path = tmp_path / "a.yaml"
    path.write_text(f"resume_from_checkpoint: {text}\nnum_train_epochs: 3.0\nlearning_rate: 2e-5\n")
    given = ["--model_name_or_path=a", "--dataset_name=b", "--output_dir=c"]
    args = parse_arguments([*given, "--config", str(path)])
    assert (args.resume_from_checkpoint, args.num_train_epochs, args.learning_rate) == (word, 3, 2e-5)
    if text != "null":
        assert parse_arguments([*given, "--resume_from_checkpoint", text]).resume_from_checkpoint == word
    path.write_text("num_train_epochs: 2.5\n")
    with pytest.raises(ValueError, match="num-train-epochs: invalid int value"):
        parse_arguments([*given, "--config", str(path)])


def test_base_dataset_and_out_are_second_names():
    args = parse_arguments(["--base=m", "--dataset", "d_d", "--out", "o", "--lora-rank", "3", "--push_to_hub"])
    expected = {"model_name_or_path": "m", "dataset_name": "d_d", "output_dir": "o", "lora_rank": 3}
    assert args == GiftTrainingArguments(**expected, push_to_hub=True)


@pytest.mark.parametrize("name", ["--checkpoint_at_steps", "--checkpoint-at-steps"])
@pytest.mark.parametrize("words", [["10000,20000"], ["10000", "20000"], ["10000,", "20000"]])
def test_steps_with_commas_or_spaces(name, words):
    assert parse_arguments([*REQUIRED, name, *words]).checkpoint_at_steps == [10000, 20000]
    assert parse_arguments([*REQUIRED, f"{name}=10000,20000"]).checkpoint_at_steps == [10000, 20000]
    with pytest.raises(ValueError, match="checkpoint_at_steps: expected numbers of updates, got 'a,5'"):
        parse_arguments([*REQUIRED, name, "a,5"])


def test_config_yaml_of_a_run_reads_back(tmp_path):
    args = parse_arguments([*REQUIRED, "--checkpoint_at_steps", "3", "--retain", "4", "--size", "56x70"])
    again = parse_arguments(write(tmp_path / "c.yaml", args.to_yaml()))
    again.config = None
    assert again == args


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lerning_rate: 1\n", r"c\.yaml: unknown key 'lerning_rate'; did you mean learning_rate\?"),
        ("config: other.yaml\n", "unknown key 'config'"),
        ("snapshot_micro_batch_size: 4\n", "unknown key 'snapshot_micro_batch_size'"),  # of earlier versions
        ("lora_rank: many\n", "lora-rank.*invalid int value: 'many'"),
        ("head: half\n", "head.*invalid choice: 'half'"),
        ("lambda_c: {a: 1}\n", "lambda_c: expected a value"),
        ("- 1\n", "expected lines of the form"),
        ("a: b: c\n", "not valid YAML"),
        ("license: \udcff\n", "not valid YAML"),
        ("lora_rank: [4, 8]\n", "lora_rank: expected one value, not a list"),
    ],
)
def test_yaml_errors_name_file_and_key(tmp_path, text, message):
    with pytest.raises(ValueError, match=message) as error:
        parse_arguments([*write(tmp_path / "c.yaml", text), *REQUIRED])
    assert "\n" not in str(error.value)


def test_missing_config_file():
    with pytest.raises(ValueError, match="--config: expected one argument"):
        parse_arguments([*REQUIRED, "--config"])
    with pytest.raises(FileNotFoundError, match=r"config nowhere\.yaml: no such file"):
        parse_arguments(["--config", "nowhere.yaml", *REQUIRED])


def test_unknown_and_missing_arguments():
    with pytest.raises(ValueError, match=r"unknown argument --lora_rnk; did you mean lora_rank\?"):
        parse_arguments([*REQUIRED, "--lora_rnk", "3"])
    with pytest.raises(ValueError, match="required: --output-dir/--out"):
        parse_arguments(REQUIRED[:4])
    with pytest.raises(ValueError, match="unknown argument stray"):
        parse_arguments([*REQUIRED, "stray"])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mixed_precision", "fp16"),
        ("retain", "some"),
        ("retain", -1),
        ("size", "56"),
        ("lora_rank", 0),
        ("micro_batch_size", 0),
        ("num_train_epochs", 0),
        ("checkpointing_steps", 0),
        ("max_steps", 0),
        ("learning_rate", 0.0),
        ("learning_rate", float("nan")),
        ("learning_rate", float("inf")),
        ("adam_beta1", 1.0),
        ("adam_beta2", -0.1),
        ("adam_epsilon", 0.0),
        ("profile", -1),
        ("eval_delay", -1),
        ("lambda_c", float("inf")),
        ("lambda_d", -1.0),
        ("lambda_d", float("nan")),
        ("seed", -1),
        ("seed", 2**32),
        ("checkpoint_at_steps", [3, 0]),
        ("prediction_kind", "depth"),
        ("modules_to_save", ["head"]),
    ],
)
def test_values_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=name):
        GiftTrainingArguments("m", "d", "o", **{name: value})


def test_a_broken_expression_is_named():
    with pytest.raises(ValueError, match="target_modules: not a regular expression"):
        GiftTrainingArguments("m", "d", "o", target_modules="(", modules_to_save=["head"])


def test_resuming_and_overwriting_exclude_each_other():
    with pytest.raises(ValueError, match="overwrite_output_dir and resume_from_checkpoint"):
        parse_arguments([*REQUIRED, "--overwrite_output_dir", "--resume_from_checkpoint", "latest"])


@pytest.mark.parametrize("name", ["depth_anything_v2_large", "depth_anything_v2_metric_large"])
def test_the_example_configurations_are_the_papers_settings(name, request):
    path = request.config.rootpath / "examples" / f"{name}.yaml"
    args = parse_arguments(["--config", str(path)])
    paper = GiftTrainingArguments("m", "d", "o")
    for key in yaml.safe_load(path.read_text()):
        if key not in ("model_name_or_path", "dataset_name", "output_dir", "size", "mixed_precision"):
            assert getattr(args, key) == getattr(paper, key), key
    assert (args.size, args.mixed_precision) == ("476x644", "bf16")


@pytest.mark.parametrize("name", ["depth_anything_v2_large", "vggt_1b", "metric3d_v2_giant"])
def test_the_configurations_with_surface_targets_keep_the_papers_other_settings(name, request):
    folder = request.config.rootpath / "examples"
    ours = parse_arguments(["--config", str(folder / f"{name}_surface.yaml")]).values()
    paper = parse_arguments(["--config", str(folder / f"{name}.yaml")]).values()
    differing = {key for key in ours.keys() & paper.keys() if ours[key] != paper[key]}
    assert differing == {"target", "lambda_c", "output_dir", "config"}
    assert ours["flip"] and ours["fills"] == 6


def test_the_home_folder_in_yaml_and_python(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    write(tmp_path / "c.yaml", "model_name_or_path: ~/m\ndataset_name: ~/d\noutput_dir: ~/o\n")
    args = parse_arguments(["--config=~/c.yaml", "--proxies_dir=~/p"])
    places = (args.model_name_or_path, args.dataset_name, args.output_dir, args.proxies_dir)
    assert places == tuple(f"{tmp_path}/{name}" for name in "mdop")
    assert GiftTrainingArguments("~/m", "d", Path("~/o")).output_dir == f"{tmp_path}/o"
