"""What a run is told: one dataclass through `transformers.HfArgumentParser`, YAML first, then the command line.

An unknown key in either is an error. The defaults are the paper's settings (section 4, implementation details), the
names those of the Hugging Face examples.
"""

import argparse
import math
import re
from collections.abc import Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Literal, get_origin

import yaml

from gift_peft.dataset.proxies import SurfaceSettings
from gift_peft.files import read_yaml
from gift_peft.models.pixels import parse_size
from gift_peft.options import OptionParser, did_you_mean, expand_home

# What a run may be resumed with when it differs: everything else changes the weights that come out.
FREE_TO_CHANGE = {
    "model_revision",  # a name of the weights, which are compared themselves
    "dataset_name",  # the folder may move: its content is compared by fingerprint
    "proxies_dir",
    "output_dir",
    "overwrite_output_dir",
    "num_train_epochs",  # a longer run has the shorter one as its beginning, but not always: LENGTH
    "max_steps",
    "retain",  # gradients do not depend on it, to the bit on CPU
    "dataloader_num_workers",
    "group_cache_dir",
    "gradient_checkpointing",  # recomputes the same bits
    "profile",
    "per_device_train_batch_size",  # how many images an update takes must stay: their product with the processes
    "gradient_accumulation_steps",
    "checkpointing_steps",
    "checkpoints_total_limit",
    "checkpoint_at_steps",
    "resume_from_checkpoint",
    "booster_root",
    "report_to",
    "license",
    "push_to_hub",
    "hub_model_id",
    "hub_private_repo",
    "config",
}
# Part of what a run is where its learning rate falls over its length, or where eval_delay lets its end be chosen.
LENGTH = {"num_train_epochs", "max_steps"}

# What one objective takes and the other refuses.
OWN = {
    "consensus": ("retain", "profile"),
    "surface": (
        "per_device_train_batch_size",
        "gradient_accumulation_steps",
        "flip",
        "color_jitter",
        "fills",
        "surface_model",
        "surface_quantile",
        "surface_tau",
    ),
}
# The groups of `--help`: the first argument of each, in the order of the dataclass, and its title.
SECTIONS = {
    "model_name_or_path": "model, data and output",
    "head": "what is trained",
    "target": "what it is trained to, and how many images at once",
    "gradient_checkpointing": "speed and memory",
    "num_train_epochs": "length and optimizer",
    "mixed_precision": "precision, order and reading",
    "metric_for_best_model": "validation, checkpoints and going on",
    "report_to": "record and sharing",
}
SELECTORS = ("gce", "normalized_gce", "tom_rmse")
LAMBDA_C = {"consensus": 1.0, "surface": 1.5}

RANGES = (
    (
        (
            "lora_rank",
            "per_device_train_batch_size",
            "gradient_accumulation_steps",
            "num_train_epochs",
            "checkpointing_steps",
            "checkpoints_total_limit",
        ),
        lambda value: value >= 1,
        "must be at least 1",
    ),
    (
        (
            "lambda_c",
            "lambda_d",
            "weight_decay",
            "max_grad_norm",
            "warmup_steps",
            "dataloader_num_workers",
            "eval_delay",
            "profile",
            "seed",
        ),
        lambda value: 0 <= value < math.inf,
        "must be finite and not negative",
    ),
    (("learning_rate", "adam_epsilon"), lambda value: 0 < value < math.inf, "must be positive and finite"),
    (("adam_beta1", "adam_beta2", "color_jitter"), lambda value: 0 <= value < 1, "must be at least 0 and below 1"),
    (("seed",), lambda value: value < 2**32, "must be below 2**32"),
    (("max_steps",), lambda value: value >= 1 or value == -1, "must be at least 1, or -1"),
    (("micro_batch_size",), lambda value: value == "auto" or value >= 1, "must be at least 1, or auto"),
    (("retain",), lambda value: value == "auto" or value >= 0, "must not be negative"),
)


def _arg(text: str, default=MISSING, synonym: str | None = None):
    """A field with its help, and a second name for it on the command line."""
    return field(default=default, metadata={"help": text, "aliases": [synonym] if synonym else []})


@dataclass
class GiftTrainingArguments:
    """Everything a run is told; `--help` prints the texts below. A value out of range is a ValueError naming it."""

    model_name_or_path: str = _arg("the base model: hub id or folder, loaded in float32", synonym="--base")
    dataset_name: str = _arg("GIFT-I: raw tree, prepared folder, parquet release or hub id", synonym="--dataset")
    output_dir: str = _arg("where the run goes: adapters, checkpoints, metrics.jsonl, config.yaml", synonym="--out")
    config: str | None = _arg("YAML file with values for these arguments; the command line wins", None)
    model_revision: str | None = _arg("branch, tag or commit of the base model", None)
    proxies_dir: str | None = _arg("folder of the teacher's predictions; default: DATASET/proxies", None)
    overwrite_output_dir: bool = _arg("delete the run that output_dir holds and start again", False)

    head: Literal["full", "lora", "none"] = _arg(
        "the depth head: trained in full (the paper), LoRA, or frozen", "full"
    )
    lora_rank: int = _arg("rank of the LoRA matrices", 8)
    target_modules: str | None = _arg("encoder modules that get LoRA (regex), for a model without a recipe", None)
    modules_to_save: list[str] = field(
        default_factory=list, metadata={"help": "head modules trained in full, for a model without a recipe"}
    )
    prediction_kind: Literal["depth", "inverse_depth"] | None = _arg(
        "what the model predicts, for a model without a recipe", None
    )
    size: str | None = _arg("HEIGHTxWIDTH at the network; default: the recipe's (476x644)", None)

    target: Literal["consensus", "surface"] = _arg(
        "what the prediction inside the target is pulled to: what its group agrees on (the paper), or the surface "
        "target, computed once from the frozen model",
        "consensus",
    )
    lambda_c: float | None = _arg(
        "weight of the group consistency, Eq. 6, or of the distance to the surface target; default 1 for consensus, "
        "1.5 for surface",
        None,
    )
    lambda_d: float = _arg("weight of the self-distillation, Eq. 6; 0 collapses the depth", 1.0)
    micro_batch_size: str = _arg(
        "images per forward: a number, or auto, what memory allows, chosen when the run starts (the paper: 2)", "auto"
    )
    retain: str = _arg("images whose graphs are kept instead of replayed: 0 (the paper), a number, or auto", "auto")
    per_device_train_batch_size: int = _arg(
        "surface: images of any groups, in one forward unless micro_batch_size is smaller", 4
    )
    gradient_accumulation_steps: int = _arg("surface: such batches per update and process", 1)
    flip: bool = _arg("surface: show every second image as in a mirror, with its own target", False)
    color_jitter: float = _arg(
        "surface: largest share by which brightness and contrast of a photo change, drawn anew", 0.0
    )
    fills: int = _arg("surface: copies of each photo with its target painted, which the targets are made from", 6)
    surface_model: Literal["auto", "plane", "quantile"] = _arg("surface: what a surface is taken for", "auto")
    surface_quantile: float | None = _arg(
        "surface: of inverse depth over the observations; higher is nearer; default 0.65, without fills 0.8", None
    )
    surface_tau: float | None = _arg(
        "surface: share of the predictions below the plane; default 0.5, without fills 0.7", None
    )
    gradient_checkpointing: bool = _arg(
        "recompute the blocks in the backward; smaller graphs, more are retained", False
    )
    compile: bool = _arg("torch.compile the encoder's blocks; changes the bits", False)
    channels_last: bool | None = _arg(
        "the head's convolutions in channels-last layout; changes the bits; default: if it trains in full", None
    )
    num_train_epochs: int = _arg("passes over the groups (one update per group) or, for surface, their images", 50)
    max_steps: int = _arg("stop after this many updates; -1: num_train_epochs decides", -1)
    learning_rate: float = _arg("Adam's learning rate at the first update", 2e-5)
    lr_scheduler_type: Literal["constant", "linear"] = _arg("constant, or falling linearly towards 0", "constant")
    warmup_steps: int = _arg("updates over which the learning rate rises to its first value", 0)
    max_grad_norm: float = _arg("scale the gradient down to this norm; 0 leaves it as it is", 0.0)
    adam_beta1: float = _arg("Adam's beta1", 0.9)
    adam_beta2: float = _arg("Adam's beta2", 0.999)
    adam_epsilon: float = _arg("Adam's epsilon", 1e-8)
    weight_decay: float = _arg("Adam's weight decay", 0.0)
    mixed_precision: Literal["no", "bf16", "fp16"] | None = _arg(
        "autocast; default: accelerate's setting, else bf16 on CUDA (compute capability 8.0 and newer) and no "
        "elsewhere; fp16 is refused",
        None,
    )
    seed: int = _arg("seed of the LoRA initialisation and of the order of the groups", 0)
    dataloader_num_workers: int = _arg("threads that decode and resize the next groups", 2)
    group_cache_dir: str | None = _arg(
        "folder for groups at network size, shared by runs; default: gift-peft/groups in the Hugging Face cache", None
    )

    metric_for_best_model: Literal["gce", "normalized_gce", "tom_rmse"] = _arg(
        "which validation figure, at its smallest, chooses adapter/", "gce"
    )
    eval_delay: int = _arg(
        "epochs before the first validation, and so before adapter/ may be chosen; the end is always validated. While "
        "the learning rate is high, the smallest GCE may be bought outside the target",
        0,
    )
    profile: int = _arg("time this many updates, print where the time goes, and stop", 0)
    checkpointing_steps: int | None = _arg("a checkpoint every so many updates; default: every epoch", None)
    checkpoints_total_limit: int | None = _arg("how many of the newest checkpoints are kept", 2)
    checkpoint_at_steps: list[str] = field(
        default_factory=list,
        metadata={"help": "updates after which a checkpoint is written and never deleted: 10000,20000 or 10000 20000"},
    )
    resume_from_checkpoint: str | None = _arg(
        "a checkpoint-<step> folder, or latest: the newest complete one in output_dir", None
    )
    booster_root: str | None = _arg("Booster's folder: ToM and Other RMSE on it at every validation", None)
    report_to: Literal["none", "tensorboard", "trackio", "wandb"] = _arg("experiment tracker", "none")
    license: str | None = _arg("licence named in the card; default: the base model's where known", None)
    push_to_hub: bool = _arg("upload the adapter when training has ended (token: hf auth login)", False)
    hub_model_id: str | None = _arg("repository for the upload; default: the name of output_dir", None)
    hub_private_repo: bool = _arg("make that repository private", False)

    def __post_init__(self):
        for name in _names():
            if isinstance(value := getattr(self, name), str | Path):
                setattr(self, name, expand_home(str(value)))
        if self.mixed_precision == "fp16":
            raise ValueError("mixed_precision: fp16 would need a loss scaler around the group step; use bf16 or no")
        for name in ("micro_batch_size", "retain"):
            if str(value := getattr(self, name)) != "auto":
                try:
                    setattr(self, name, int(value))
                except ValueError:
                    raise ValueError(f"{name}: expected auto or a number of images, got {value!r}") from None
        if self.size is not None:
            parse_size(self.size)
        for names, holds, text in RANGES:
            for name in names:
                if (value := getattr(self, name)) is not None and not holds(value):
                    raise ValueError(f"{name}: {text}, got {value}")
        try:
            words = [word for step in self.checkpoint_at_steps for word in str(step).split(",") if word.strip()]
            self.checkpoint_at_steps = [int(word) for word in words]
        except ValueError:
            given = " ".join(map(str, self.checkpoint_at_steps))
            raise ValueError(f"checkpoint_at_steps: expected numbers of updates, got {given!r}") from None
        if any(step < 1 for step in self.checkpoint_at_steps):
            raise ValueError(f"checkpoint_at_steps: must be at least 1, got {min(self.checkpoint_at_steps)}")
        # transformers takes True for the newest checkpoint as well; of a bare true YAML leaves the word yes.
        words = {"true": "latest", "yes": "latest", "false": None, "no": None}
        given = self.resume_from_checkpoint
        self.resume_from_checkpoint = words.get(str(given).lower(), given)
        self._check_recipe()
        self._check_objective()
        if self.overwrite_output_dir and self.resume_from_checkpoint:
            raise ValueError("overwrite_output_dir and resume_from_checkpoint exclude each other")

    def _check_recipe(self) -> None:
        """The three arguments that spell a recipe out."""
        if bool(self.target_modules) != bool(self.modules_to_save):
            raise ValueError("target_modules and modules_to_save: give both or neither")
        if self.prediction_kind and not self.target_modules:
            raise ValueError("prediction_kind: the recipe says it; only with target_modules and modules_to_save")
        try:
            re.compile(self.target_modules or "")
        except re.error as error:
            raise ValueError(f"target_modules: not a regular expression: {error}") from None

    def _check_objective(self) -> None:
        """Refuse what only the other objective takes; settle what has a default for each."""
        if self.target not in OWN:
            raise ValueError(f"target: {self.target!r} is neither consensus nor surface")
        if self.metric_for_best_model not in SELECTORS:
            raise ValueError(
                f"metric_for_best_model: expected {', '.join(SELECTORS)}, got {self.metric_for_best_model}"
            )
        defaults = {f.name: f.default for f in fields(self)}
        for name in self._foreign():
            if getattr(self, name) != defaults[name]:
                raise ValueError(f"{name}: target: {self.target} does not take it")
        if self.lambda_c is None:
            self.lambda_c = LAMBDA_C[self.target]
        settings = self.surface_settings()
        if self.target == "surface":
            self.surface_quantile, self.surface_tau = settings.surface_quantile, settings.surface_tau

    def _foreign(self) -> tuple[str, ...]:
        (other,) = OWN.keys() - {self.target}
        return OWN[other]

    def surface_settings(self) -> SurfaceSettings:
        """How this run's surface targets are made. The fills' colors do not depend on the run's seed."""
        options = ("fills", "surface_model", "surface_quantile", "surface_tau")
        return SurfaceSettings(**{name: getattr(self, name) for name in options})

    def values(self) -> dict:
        """All values by name, without those that only the other objective takes."""
        return {name: value for name, value in asdict(self).items() if name not in self._foreign()}

    def to_yaml(self) -> str:
        """All values as `--config` reads them, without what is None or empty and without the two about resuming."""
        skip = ("config", "overwrite_output_dir", "resume_from_checkpoint")
        values = {k: v for k, v in self.values().items() if k not in skip and v is not None and v != []}
        return yaml.safe_dump(values, sort_keys=False, allow_unicode=True)


def make_parser() -> OptionParser:
    parser = OptionParser(
        "train",
        "Fine-tune a model on groups of images into an adapter; --base, --dataset and --out are needed.",
        "gift-peft train --base depth-anything/Depth-Anything-V2-Small-hf --dataset gift-i --out run",
        parents=[_hf_argument_parser()(GiftTrainingArguments, add_help=False)],
    )
    text = "say what a run would do, need and miss, and write nothing; exit code 1 if it would fail"
    parser.add_argument("--dry-run", action="store_true", help=text)
    # HfArgumentParser knows no groups, so its options are moved into them.
    parser.usage = "%(prog)s --base ID --dataset ID --out DIR [options]"
    actions = {action.dest: action for action in parser._actions}
    actions["channels_last"].nargs, actions["channels_last"].const = "?", True  # alone it means yes, as plain flags do
    group = parser
    for name in _names():
        if name in SECTIONS:
            group = parser.add_argument_group(SECTIONS[name])
        parser._optionals._group_actions.remove(actions[name])
        group._group_actions.append(actions[name])
    return parser


def _hf_argument_parser() -> type[argparse.ArgumentParser]:
    """transformers' `HfArgumentParser`, from its own file: with transformers come our models, and with them torch."""
    file = Path(find_spec("transformers").origin).with_name("hf_argparser.py")
    spec = spec_from_file_location(file.stem, file)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.HfArgumentParser


def parse_arguments(argv: Sequence[str]) -> GiftTrainingArguments:
    """`argv` (without the program's name) over the YAML file of `--config` over the defaults.

    Raises ValueError naming the argument: an unknown key (with the nearest known one), a missing one, a wrong type.
    FileNotFoundError if the YAML file does not exist.
    """
    config = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    config.add_argument("--config", type=Path)
    parser = make_parser()
    config.error = parser.error = _raise
    path = expand_home(config.parse_known_args(argv)[0].config)
    from_file = [] if path is None else _yaml_to_argv(path)
    for option in (word.partition("=")[0] for word in argv if word.startswith("--")):
        if not parser.knows(option):
            near = did_you_mean(option[2:].replace("-", "_"), _names())
            raise ValueError(f"unknown argument {option}{near}")
    values, unknown = parser.parse_known_args([*from_file, *argv])
    if unknown:
        raise ValueError(f"unknown argument {unknown[0]}")
    if values.dry_run:  # `run` of the verb has taken it out
        raise ValueError("dry_run: only `gift-peft train` has it")
    return GiftTrainingArguments(**{name: getattr(values, name) for name in _names()})


def _raise(message: str):
    raise ValueError(message)


def _yaml_to_argv(path: Path) -> list[str]:
    """The file's keys as if they stood on the command line, so that both are checked by the same parser."""
    values = read_yaml(path, f"config {path}")
    argv = []
    types = {f.name: f.type for f in fields(GiftTrainingArguments)}
    for key, value in values.items():
        if key not in _names() or key == "config":
            raise ValueError(f"config {path}: unknown key {key!r}{did_you_mean(str(key), _names())}")
        if isinstance(value, dict):
            raise ValueError(f"config {path}: {key}: expected a value, not a mapping")
        if isinstance(value, list) and get_origin(types[key]) is not list:
            raise ValueError(f"config {path}: {key}: expected one value, not a list")
        if isinstance(value, bool) and types[key] is not bool:
            value = "yes" if value else "no"  # what YAML makes of `mixed_precision: no`
        if isinstance(value, float) and types[key] is int and value.is_integer():
            value = int(value)  # `num_train_epochs: 3.0`, as transformers writes it
        if isinstance(value, list):
            argv += [f"--{key}", *map(str, value)] if value else []
        elif value is not None:
            argv.append(f"--{key}={value}")
    return argv


def _names() -> list[str]:
    return [f.name for f in fields(GiftTrainingArguments)]
