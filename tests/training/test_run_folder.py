"""Whose the output folder's files are: a run is known by its marks, and nothing else is replaced or deleted."""

import json
import shutil
from pathlib import Path

import pytest
from helpers.runs import arguments, rows_of, train_again

from gift_peft.training import parse_arguments, run_folder, train
from gift_peft.training.run_folder import check_folder, delete_run, holds_run, write_config

# transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning")


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def write(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


OWN_CONFIG = "# my settings, a year of them\nmodel_name_or_path: {base}\ndataset_name: {tree}\nmax_steps: 1\n"
# What people have in folders, under the names that runs use too.
PROJECTS = {
    "settings": {"config.yaml": OWN_CONFIG},
    "bare settings": {"config.yaml": "learning_rate: 0.1\nmax_steps: 5\n"},
    "no mapping": {"config.yaml": "- a\n- b\n"},
    "broken": {"config.yaml": "a: [1\n"},
    "metrics": {"metrics.jsonl": json.dumps({"step": 1, "loss": 0.5}) + "\n"},
    "no metrics": {"metrics.jsonl": ""},
    "another trainer": {"checkpoint-500/trainer_state.json": "{}", "checkpoint-500/optimizer.pt": "0"},
    "another adapter": {"adapter/adapter_config.json": "{}", "adapter/adapter_model.safetensors": ""},
    "a file": {"adapter-last": "notes"},
}


@pytest.mark.parametrize("name", PROJECTS)
@pytest.mark.parametrize("overwrite", [False, True])
def test_what_no_run_wrote_is_kept(name, overwrite, base_dir, tree, tmp_path, monkeypatch):
    out = write(tmp_path / "project", {"logs/notes.txt": "a year of notes", **PROJECTS[name]})
    if name == "settings":
        (out / "config.yaml").write_text(OWN_CONFIG.format(base=base_dir, tree=tree))
    before = snapshot(out)
    monkeypatch.setattr(
        "gift_peft.training.loop.load_base", lambda *given: pytest.fail("told before a model is loaded")
    )
    argv = ["--config", str(out / "config.yaml")] if name == "settings" else []
    argv += [f"--base={base_dir}", f"--dataset={tree}", f"--out={out}"] + ["--overwrite_output_dir"] * overwrite
    first = next(iter(PROJECTS[name])).split("/")[0]
    with pytest.raises(
        ValueError, match=rf"output_dir: .*project has {first}.*which no run of gift-peft wrote"
    ) as error:
        train(parse_arguments(argv))
    assert "\n" not in str(error.value) and snapshot(out) == before


def test_a_run_in_somebodys_folder_takes_only_its_own_with_it(base_dir, tree, tmp_path):
    theirs = {
        "logs/notes.txt": "mine",
        "logs/gift-peft/notes.txt": "mine",
        "notes.md": "mine",
        "runs/a/events.out": "",
    }
    out = write(tmp_path / "out", theirs)
    train(arguments(base_dir, tree, out, max_steps=1, report_to="tensorboard"))
    events = {name for name in snapshot(out) if "tfevents" in name or name.endswith("hparams.yml")}
    assert events and holds_run(out)
    delete_run(out)
    assert snapshot(out) == {name: text.encode() for name, text in theirs.items()}
    assert not holds_run(out)


def test_a_file_put_into_a_runs_folder_is_not_deleted(base_dir, tree, whole, tmp_path):
    for place in ("adapter", "checkpoint-4", "checkpoint-4/best"):
        out = Path(shutil.copytree(whole, tmp_path / place.replace("/", "-")))
        write(out, {f"{place}/notes.txt": "mine"})
        before = snapshot(out)
        with pytest.raises(ValueError, match=r"holds files that were not written by this command \(.*notes\.txt\)"):
            train(arguments(base_dir, tree, out, overwrite_output_dir=True))
        assert snapshot(out) == before


def test_a_note_in_an_old_checkpoint_keeps_it(base_dir, tree, tmp_path):
    out = tmp_path / "out"
    args = arguments(base_dir, tree, out, checkpoints_total_limit=1, max_steps=1)
    train(args)
    write(out, {"checkpoint-1/notes.txt": "the good one"})
    with pytest.raises(ValueError, match="checkpoint-1 holds files"):  # going on could have to replace it
        train_again(args, max_steps=3)
    from gift_peft.training.checkpoints import prune_checkpoints

    shutil.copytree(out / "checkpoint-1", out / "checkpoint-2")
    (out / "checkpoint-2/notes.txt").unlink()
    shutil.copytree(out / "checkpoint-2", out / "checkpoint-3")
    prune_checkpoints(out, 3, 1, [])
    assert sorted(folder.name for folder in out.glob("checkpoint-*")) == ["checkpoint-1", "checkpoint-3"]


def test_a_config_edited_by_hand_stays_or_is_told(base_dir, tree, tmp_path):
    out = tmp_path / "out"
    args = arguments(base_dir, tree, out, max_steps=1)
    train(args)
    config = out / "config.yaml"
    assert config.read_text().startswith(run_folder.MARK)
    edited = "# three updates are enough\n" + config.read_text().replace("max_steps: 1", "max_steps: 2  # not 1")
    config.write_text(edited)
    with pytest.raises(ValueError, match=r"has config\.yaml, which .*changed by hand"):
        train_again(args, max_steps=3)
    train(parse_arguments(["--config", str(config), "--resume_from_checkpoint", "latest"]))
    assert config.read_text() == edited and len(rows_of(out)) == 3
    train(parse_arguments(["--config", str(config), "--overwrite_output_dir"]))
    assert config.read_text() == edited and len(rows_of(out)) == 2


def test_a_run_of_an_earlier_version_is_known(base_dir, tree, whole, tmp_path):
    out = Path(shutil.copytree(whole, tmp_path / "old"))
    text = (out / "config.yaml").read_text()
    (out / "config.yaml").write_text(text.removeprefix(run_folder.MARK))  # as 0.1.0 wrote it
    args = arguments(base_dir, tree, out, overwrite_output_dir=True)
    check_folder(out, args)
    delete_run(out)
    assert not list(out.iterdir())
    write_config(out, args)
    assert holds_run(out)  # killed before anything else


def test_a_copy_of_a_runs_config_alone_is_no_settings_of_somebody(base_dir, tree, whole, tmp_path):
    """Copied as it is, nothing is lost when a run there writes its own."""
    out = tmp_path / "new"
    out.mkdir()
    shutil.copy(whole / "config.yaml", out)
    train(
        parse_arguments(
            ["--config", str(out / "config.yaml"), f"--out={out}", "--overwrite_output_dir", "--max_steps=1"]
        )
    )
    assert (out / "adapter").is_dir() and f"output_dir: {out}" in (out / "config.yaml").read_text()
