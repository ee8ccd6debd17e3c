"""Proxies that no longer hold, or cannot be made: refused in one line that says why and what to do."""

import json
import os
import re
import shutil
from types import SimpleNamespace

import pytest
import safetensors.torch
import torch
from accelerate import PartialState
from helpers.records import one_line
from helpers.tiny import SIZE, tiny_model, tiny_processor, write_base
from PIL import Image

from gift_peft.dataset import shares
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.proxies import SurfaceSettings, default_proxies_dir, read_header, write_proxies
from gift_peft.dataset.tensors import collate_group
from gift_peft.models import loading
from gift_peft.models.identity import teacher_id, teacher_revision
from gift_peft.training import teacher
from gift_peft.training.teacher import make_proxies

pytestmark = pytest.mark.usefixtures("fresh_cache")


def copy_base(base_dir, folder):
    return shutil.copytree(base_dir, folder)


def repaint(raw):
    Image.new("RGB", (80, 60), (9, 8, 7)).save(raw / "validation/scene_100/1.png")


def retreat(raw):
    Image.new("RGB", (80, 60), (9, 8, 7)).save(raw / "validation/scene_100/reference.png")


def add_image(raw):
    Image.new("RGB", (80, 60)).save(raw / "validation/scene_100/2.png")
    shutil.copy(raw / "validation/scene_100/masks/1.png", raw / "validation/scene_100/masks/2.png")


STALE = {
    "image": (repaint, "image 1.png has changed since"),
    "reference": (retreat, "the treated reference has changed since"),
    "count": (add_image, "it was made for 2 images, and the group has 3"),
}


@pytest.mark.parametrize("name", STALE)
def test_changed_images_make_proxies_stale(raw_tree, base_dir, name):
    change, reason = STALE[name]
    folder = make_proxies(base_dir, raw_tree, size=SIZE)
    change(raw_tree)
    path = folder / "validation/scene_100.safetensors"
    with pytest.raises(ValueError) as excinfo:
        load_gift_i(raw_tree, "validation", teacher=base_dir)[0]
    one_line(excinfo, f"stale proxy {path}: {reason}", f"gift-peft proxies --base {base_dir}", "--overwrite")
    with pytest.raises(ValueError) as excinfo:
        make_proxies(base_dir, raw_tree, size=SIZE)
    one_line(excinfo, f"stale proxy {path}: {reason}", "--overwrite")
    make_proxies(base_dir, raw_tree, size=SIZE, overwrite=True)
    row = load_gift_i(raw_tree, "validation", teacher=base_dir)[0]
    assert len(row["proxies"]) == len(row["images"])


def test_reencoded_images_keep_their_proxies(raw_tree, base_dir):
    make_proxies(base_dir, raw_tree, size=SIZE)
    path = raw_tree / "train/scene_0/0.png"
    before = path.read_bytes()
    Image.open(path).save(path, compress_level=1)
    assert path.read_bytes() != before
    assert load_gift_i(raw_tree, "train", teacher=base_dir)[0]["proxies"] is not None


def test_other_weights_under_the_same_path_are_detected(raw_tree, base_dir, tmp_path):
    base = copy_base(base_dir, tmp_path / "base")
    folder = make_proxies(base, raw_tree, size=SIZE)
    shutil.copytree(base, tmp_path / "moved" / "base")  # the same model elsewhere is the same teacher
    assert load_gift_i(raw_tree, "train", teacher=tmp_path / "moved" / "base")[0]["proxies"] is not None
    shutil.rmtree(base)
    write_base(base, seed=1)
    for use in (
        lambda: load_gift_i(raw_tree, "train", teacher=base)[0],
        lambda: make_proxies(base, raw_tree, size=SIZE),
    ):
        with pytest.raises(ValueError) as excinfo:
            use()
        one_line(excinfo, f"stale proxy {folder / 'train/scene_0.safetensors'}", "model or revision tensors:")


def test_sets_of_several_sizes_lie_side_by_side(raw_tree, base_dir):
    small = make_proxies(base_dir, raw_tree, size=SIZE)
    before = {path: path.read_bytes() for path in small.rglob("*.safetensors")}
    large = make_proxies(base_dir, raw_tree, size="56x84")
    teacher_folder = raw_tree / "proxies" / base_dir.name
    assert (small, large) == (teacher_folder / "56x70", teacher_folder / "56x84")
    assert {path: path.read_bytes() for path in small.rglob("*.safetensors")} == before
    for size in (SIZE, (56, 84)):
        assert load_gift_i(raw_tree, "train", teacher=base_dir, size=size)[0]["proxies"].shape == (2, *size)
    with pytest.raises(ValueError) as excinfo:  # none is guessed
        load_gift_i(raw_tree, "train", teacher=base_dir)
    one_line(excinfo, "at 56x70 and 56x84: give the size")
    with pytest.raises(FileNotFoundError) as excinfo:
        load_gift_i(raw_tree, "train", teacher=base_dir, size=(28, 42))[0]
    one_line(excinfo, "missing proxy", "28x42/train/scene_0.safetensors", "--size 28x42`")


def as_before(folder):
    """The set where 0.1.0 had it, without its size in the path."""
    for split in ("train", "validation"):
        shutil.move(folder / split, folder.parent / split)
    folder.rmdir()
    return folder.parent


def test_a_set_of_an_earlier_version_is_read_and_kept(raw_tree, base_dir):
    settings = SurfaceSettings(fills=1)
    folder = make_proxies(base_dir, raw_tree, size=SIZE, surface=settings)
    new = load_gift_i(raw_tree, "train", teacher=base_dir, surface=settings)[1]
    old = as_before(folder)
    files = {path: path.read_bytes() for path in old.rglob("*.safetensors")}
    for size in (None, SIZE):
        row = load_gift_i(raw_tree, "train", teacher=base_dir, size=size, surface=settings)[1]
        assert all(
            torch.equal(row[name], new[name]) for name in ("proxies", "surface_target", "surface_target_flipped")
        )
    make_proxies(base_dir, raw_tree, size=SIZE, surface=settings)
    assert {path: path.read_bytes() for path in old.rglob("*.safetensors")} == files  # nothing to do
    make_proxies(base_dir, raw_tree, size="56x84", surface=settings)  # it is not stale for being of another size
    assert load_gift_i(raw_tree, "train", teacher=base_dir, size=(56, 84))[0]["proxies"].shape == (2, 56, 84)
    repaint(raw_tree)
    with pytest.raises(ValueError) as excinfo:
        make_proxies(base_dir, raw_tree, size=SIZE)
    one_line(excinfo, f"stale proxy {old / 'validation/scene_100.safetensors'}", "--overwrite")
    make_proxies(base_dir, raw_tree, size=SIZE, overwrite=True)
    assert load_gift_i(raw_tree, "validation", teacher=base_dir, size=SIZE)[0]["proxies"].shape == (2, *SIZE)
    assert all(
        path.read_bytes() == content for path, content in files.items()
    )  # the new set is used, the old one kept


def test_an_earlier_set_that_is_damaged_is_as_none(raw_tree, base_dir):
    old = as_before(make_proxies(base_dir, raw_tree, size=SIZE))
    for path in old.rglob("*.safetensors"):
        path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(FileNotFoundError, match=r"missing proxy .*56x70"):
        load_gift_i(raw_tree, "train", teacher=base_dir, size=SIZE)[0]
    make_proxies(base_dir, raw_tree, size=SIZE)
    assert load_gift_i(raw_tree, "train", teacher=base_dir)[0]["proxies"].shape == (2, *SIZE)


def test_other_size_or_processor(raw_tree, base_dir, tmp_path):
    base = copy_base(base_dir, tmp_path / "base")
    make_proxies(base, raw_tree, size=SIZE)
    row = load_gift_i(raw_tree, "train", teacher=base)[0]
    with pytest.raises(ValueError, match=r"scene_0: its proxies are 56x70 but the size in use is 56x84"):
        collate_group(row, tiny_processor(), (56, 84))
    settings = json.loads((base / "preprocessor_config.json").read_text())
    (base / "preprocessor_config.json").write_text(json.dumps({**settings, "resample": 2}))
    with pytest.raises(ValueError, match="stale proxy"):
        load_gift_i(raw_tree, "train", teacher=base)[0]


def test_hub_ids_are_pinned_by_commit(raw_tree, base_dir, tmp_path, monkeypatch):
    """A stand-in for the hub's local cache: `main` moves from one commit to the next."""
    commits = {}

    def cached_file(repository, name, revision=None):
        if repository != "owner/net":
            raise OSError(f"{repository} is not a repository\nand more lines")
        return f"/cache/models--owner--net/snapshots/{commits[revision or 'main']}/{name}"

    monkeypatch.setattr("transformers.utils.hub.cached_file", cached_file)
    monkeypatch.setattr(loading, "load_base", lambda *given, **options: (tiny_model(), tiny_processor()))
    commits["main"] = commits["v1"] = "a" * 40
    assert teacher_id("owner/net") == "owner--net" and teacher_id("owner/net", "v1") == "owner--net@v1"
    assert teacher_revision("owner/net", "v1") == "a" * 40
    folder = make_proxies("owner/net", raw_tree, size=SIZE)
    make_proxies("owner/net", raw_tree, size=SIZE, revision="v1")
    commits["main"] = "b" * 40
    with pytest.raises(ValueError) as excinfo:
        load_gift_i(raw_tree, "train", teacher="owner/net")[0]
    one_line(excinfo, folder, f"model or revision {'a' * 40}, not {'b' * 40}")
    row = load_gift_i(raw_tree, "train", teacher="owner/net", revision="v1")[0]
    assert row["proxies"].shape == (2, *SIZE)
    with pytest.raises(FileNotFoundError) as excinfo:
        load_gift_i(raw_tree, "train", teacher="owner/other")
    one_line(excinfo, "owner/other")


def test_missing_proxy_names_file_and_command(raw_tree, base_dir):
    with pytest.raises(FileNotFoundError) as excinfo:
        load_gift_i(raw_tree, "train", teacher=base_dir, size=SIZE)[0]
    command = f"gift-peft proxies --base {base_dir} --dataset {raw_tree} --size 56x70"
    one_line(excinfo, raw_tree / "proxies" / base_dir.name / "56x70/train/scene_0.safetensors", f"`{command}`")


def test_a_proxy_file_that_lacks_an_image(raw_tree, base_dir):
    path = make_proxies(base_dir, raw_tree, size=SIZE) / "train/scene_1.safetensors"
    write_proxies(path, read_header(path), safetensors.torch.load_file(path)["proxies"][:2], None)
    with pytest.raises(ValueError) as excinfo:
        load_gift_i(raw_tree, "train", teacher=base_dir)[1]
    one_line(excinfo, f"damaged proxy {path} (it holds 2 of 3 proxies)", "gift-peft proxies")


def test_one_flipped_bit_in_a_proxy_is_noticed(raw_tree, base_dir):
    folder = make_proxies(base_dir, raw_tree, size=SIZE)
    for name in ("proxies", "reference"):
        path = folder / "validation/scene_100.safetensors"
        whole = path.read_bytes()
        with safetensors.safe_open(path, "pt") as file:
            metadata, tensors = file.metadata(), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        bits = tensors[name].view(torch.int32)
        bits.view(-1)[7] ^= 1 << 5  # finite still, and near to what it was
        path.write_bytes(safetensors.torch.save(tensors, metadata))
        with pytest.raises(ValueError) as excinfo:
            load_gift_i(raw_tree, "validation", teacher=base_dir)[0]
        one_line(excinfo, f"damaged proxy {path} (values of {name} have changed", "gift-peft proxies", "--overwrite")
        path.write_bytes(whole)
    load_gift_i(raw_tree, "validation", teacher=base_dir)[0]


def test_damaged_and_nan_proxies(raw_tree, base_dir):
    path = make_proxies(base_dir, raw_tree, size=SIZE) / "validation/scene_100.safetensors"
    tensors, header = safetensors.torch.load_file(path), read_header(path)
    for key, at, name in (("proxies", (1, 3, 4), "1.png"), ("reference", (3, 4), "reference")):
        bad = {other: tensor.clone() for other, tensor in tensors.items()}
        bad[key][at] = float("nan")
        write_proxies(path, header, **bad)
        with pytest.raises(ValueError) as excinfo:
            load_gift_i(raw_tree, "validation", teacher=base_dir)[0]
        one_line(excinfo, f"NaN or infinite values in proxy {path} ({name})", "gift-peft proxies")
    safetensors.torch.save_file({"other": torch.zeros(1)}, path)
    with pytest.raises(ValueError, match=r"damaged proxy .*scene_100.*not a proxy file"):
        load_gift_i(raw_tree, "validation", teacher=base_dir)[0]
    for text in ("{", json.dumps({key: header[key] for key in header if key != "images"})):
        safetensors.torch.save_file(tensors, path, metadata={"gift_peft": text})
        with pytest.raises(ValueError, match=r"(damaged|stale) proxy .*scene_100.*--overwrite"):
            load_gift_i(raw_tree, "validation", teacher=base_dir)[0]
    write_proxies(path, header, **tensors)
    path.write_bytes(path.read_bytes()[:500])
    for use in (
        lambda: load_gift_i(raw_tree, "validation", teacher=base_dir)[0],
        lambda: make_proxies(base_dir, raw_tree, size=SIZE),
    ):
        with pytest.raises(ValueError) as excinfo:
            use()
        one_line(excinfo, f"damaged proxy {path}", f"`gift-peft proxies --base {base_dir} --dataset", "--overwrite`")


def test_nan_predictions_name_group_and_image(raw_tree, base_dir, tmp_path):
    base = tiny_model()
    with torch.no_grad():
        base.head.conv3.bias.fill_(float("nan"))
    base.save_pretrained(tmp_path / "nan")
    tiny_processor().save_pretrained(tmp_path / "nan")
    with pytest.raises(ValueError) as excinfo:
        make_proxies(tmp_path / "nan", raw_tree, size=SIZE)
    one_line(excinfo, "group scene_0, 0.png", "NaN")
    assert not list((raw_tree / "proxies").rglob("*.safetensors"))


def test_wrong_bases_and_sizes(raw_tree, base_dir, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"base model .*nowhere: no such folder"):
        make_proxies(tmp_path / "nowhere", raw_tree)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"empty: the folder has no config.json"):
        make_proxies(tmp_path / "empty", raw_tree)
    only_model = copy_base(base_dir, tmp_path / "bare")
    (only_model / "preprocessor_config.json").unlink()
    with pytest.raises(FileNotFoundError, match=re.escape(str(only_model))):
        make_proxies(only_model, raw_tree, size=SIZE)
    with pytest.raises(ValueError, match="multiples of the patch size 14"):
        make_proxies(base_dir, raw_tree, size=(50, 70))
    cut = copy_base(base_dir, tmp_path / "cut")
    (cut / "model.safetensors").write_bytes((base_dir / "model.safetensors").read_bytes()[:2000])
    other = copy_base(base_dir, tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    (other / "config.json").write_text(json.dumps({**config, "head_hidden_size": 16}))
    for base in (cut, other):
        with pytest.raises(ValueError) as excinfo:
            make_proxies(base, raw_tree, size=SIZE)
        one_line(excinfo, f"base model {base}: ")


def test_the_processor_that_accelerate_was_told_is_used(raw_tree, base_dir, monkeypatch):
    asked = []
    state = PartialState()
    monkeypatch.setattr(teacher, "PartialState", lambda cpu: asked.append(cpu) or state)
    for value in ("true", "false"):
        monkeypatch.setenv("ACCELERATE_USE_CPU", value)
        make_proxies(base_dir, raw_tree, size=SIZE)
    assert asked == [True, False]


def test_a_folder_that_cannot_be_written_is_told_like_any_error(raw_tree, base_dir, monkeypatch):
    """In all processes, which hear of it before any goes on."""
    told = []
    monkeypatch.setattr(shares, "gather_object", lambda items: told.extend(items) or items)
    two = SimpleNamespace(process_index=0, num_processes=2, is_main_process=True, device=torch.device("cpu"))

    def refuse(path, *args):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(teacher, "write_proxies", refuse)
    with pytest.raises(PermissionError, match=r"scene_0\.safetensors") as excinfo:
        make_proxies(base_dir, raw_tree, size=SIZE, accelerator=two)
    assert told == [excinfo.value]


def test_where_proxies_are_kept(tmp_path, monkeypatch):
    """In the dataset's folder where that can be written or brings them, else in the cache."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HOME", str(tmp_path / "home"))
    cached = tmp_path / "home/gift-peft/proxies"
    (tmp_path / "a").mkdir()
    assert default_proxies_dir(tmp_path / "a", "net") == tmp_path / "a" / "proxies"
    assert default_proxies_dir("owner/gift-i", "net") == cached / "owner--gift-i"
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert default_proxies_dir(tmp_path / "a", "net").parent == cached
    (tmp_path / "a/proxies/net").mkdir(parents=True)
    assert default_proxies_dir(tmp_path / "a", "net") == tmp_path / "a" / "proxies"


def test_two_runs_may_make_the_same_proxies(tmp_path, monkeypatch):
    header = {"format": "test"}
    proxies = torch.ones(2, 4, 4)
    write_proxies(tmp_path / "a.safetensors", header, proxies, None)
    other = tmp_path / ".a.b.123.partial"  # of the group a.b, still being written
    other.touch()

    def taken_away(source, target):
        os.unlink(source)
        raise FileNotFoundError(source)

    monkeypatch.setattr("gift_peft.dataset.proxies.os.replace", taken_away)
    write_proxies(tmp_path / "a.safetensors", header, proxies, None)  # the other run's file is the same
    with pytest.raises(FileNotFoundError):
        write_proxies(tmp_path / "new.safetensors", header, proxies, None)
    assert other.exists()
