"""What comes from others runs no code, reads nothing outside its folder, and, damaged at random, is one clear line."""

import io
import json
import pickle
import random
import shutil
import struct
import zipfile
import zlib
from pathlib import Path

import datasets
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from datasets import Dataset, Image, List
from helpers.runs import arguments
from helpers.tiny import SIZE, tiny_processor, write_raw_tree
from PIL import Image as PilImage

from gift_peft.adapters.folder import read_adapter_config, read_gift, save_adapter
from gift_peft.adapters.recipes import get_gift_model
from gift_peft.dataset.gift_i import FEATURES, gift_i_splits, load_gift_i
from gift_peft.dataset.writer import write_gift_i
from gift_peft.images import open_image, read_image
from gift_peft.models.loading import DepthModel, load_base
from gift_peft.models.pixels import resolve_size
from gift_peft.training import train

# the warnings are of libraries, about damaged files
pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("fresh_cache")]
FUZZ = 150  # inputs of each kind


@pytest.fixture(scope="module")
def adapter(base_dir, tmp_path_factory):
    folder = tmp_path_factory.mktemp("adapter") / "adapter"
    model = get_gift_model(load_base(base_dir)[0])
    save_adapter(model, folder, str(base_dir), processor=tiny_processor(), size=SIZE, gift={"base_revision": None})
    return folder


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    raw = write_raw_tree(root / "raw")
    columns = ("group_id", "image_names", "images", "masks", "reference")
    groups = [
        {"split": split, **{key: row[key] for key in columns}}
        for split in gift_i_splits(raw)
        for row in load_gift_i(raw, split)
    ]
    return write_gift_i(groups, root / "gift-i", license="cc0-1.0")


class Code:
    """Unpickled, it leaves a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


# ---- no foreign code ----


def test_a_base_in_a_pickle_that_runs_code_is_refused(base_dir, tmp_path):
    base = shutil.copytree(base_dir, tmp_path / "base")
    (base / "model.safetensors").unlink()
    torch.save({"x": Code(tmp_path / "ran")}, base / "pytorch_model.bin")
    for load in (load_base, DepthModel.from_pretrained):
        with pytest.raises((ValueError, OSError)) as caught:
            load(base)
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "ran").exists()


def test_an_adapter_in_a_pickle_is_not_read(base_dir, adapter, tmp_path):
    folder = shutil.copytree(adapter, tmp_path / "adapter")
    (folder / "adapter_model.safetensors").unlink()
    (folder / "adapter_model.bin").write_bytes(pickle.dumps(Code(tmp_path / "ran")))
    with pytest.raises(FileNotFoundError, match=r"the folder has no adapter_model\.safetensors"):
        DepthModel.from_pretrained(base_dir, folder)
    assert not (tmp_path / "ran").exists()


def test_a_base_that_brings_code_is_refused_without_asking(base_dir, tmp_path):
    base = shutil.copytree(base_dir, tmp_path / "base")
    (base / "custom.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nclass C: pass\n")
    config = json.loads((base / "config.json").read_text())
    auto_map = {"AutoConfig": "custom.C", "AutoModelForDepthEstimation": "custom.C"}
    config |= {"model_type": "unheard_of", "auto_map": auto_map}
    (base / "config.json").write_text(json.dumps(config))
    for load in (load_base, DepthModel.from_pretrained):
        with pytest.raises(ValueError, match=r"base model .*base: "):
            load(base)
    assert not (tmp_path / "ran").exists()


def test_an_adapter_cannot_have_a_module_imported(base_dir, adapter, tmp_path, monkeypatch):
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    folder = shutil.copytree(adapter, tmp_path / "adapter")
    config = json.loads((folder / "adapter_config.json").read_text())
    config |= {"megatron_config": {"a": 1}, "megatron_core": "evil"}
    config["auto_mapping"] = {"base_model_class": "X", "parent_library": "evil"}
    (folder / "adapter_config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=r"adapter_config\.json \(megatron_config cannot be"):
        DepthModel.from_pretrained(base_dir, folder)
    assert not (tmp_path / "ran").exists()


# ---- nothing outside of the folder ----


@pytest.mark.parametrize(
    "place", ["../../secret.png", "{root}/secret.png", "http://127.0.0.1/x.png", "file://{root}/x"]
)
def test_metadata_may_not_lead_out_of_its_folder(place, prepared, tmp_path):
    folder = shutil.copytree(prepared, tmp_path / "gift-i")
    shutil.copy(next((folder / "train").rglob("*.png")), tmp_path / "secret.png")
    path = folder / "train/metadata.parquet"
    table = pq.read_table(path)
    rows = table.to_pylist()
    rows[0]["images_file_names"][0] = place.format(root=tmp_path)
    pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), path)
    with pytest.raises(ValueError, match="file_name") as caught:
        load_gift_i(folder, "train")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "place", ["../secret.png", "{root}/secret.png", "file://{root}/secret.png", "zip://a.png::{root}/a.zip"]
)
def test_parquet_may_not_name_files(place, prepared, tmp_path, monkeypatch):
    secret = Path(shutil.copy(next((prepared / "train").rglob("*.png")), tmp_path / "secret.png"))
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.write(secret, "a.png")
    rows = list(load_gift_i(prepared, "train").with_format(None))
    stored = [{**row, **{key: [] for key in ("images", "masks")}} for row in rows]
    for row, target in zip(rows, stored, strict=True):
        for key in ("images", "masks"):
            for picture in row[key]:
                buffer = io.BytesIO()
                picture.save(buffer, "PNG")
                target[key].append({"bytes": buffer.getvalue(), "path": None})
    stored[0]["images"][0] = {"bytes": None, "path": place.format(root=tmp_path)}
    features = FEATURES.copy() | {key: List(Image(decode=False)) for key in ("images", "masks")}
    (tmp_path / "release").mkdir()
    monkeypatch.chdir(tmp_path / "release")
    Dataset.from_list(stored, features=datasets.Features(features)).to_parquet(
        tmp_path / "release/train-00000-of-00001.parquet"
    )
    with pytest.raises(ValueError, match=r"group scene_0, image: .* is a path outside of the dataset"):
        load_gift_i(tmp_path / "release", "train")


@pytest.mark.parametrize("name", ["../evil", "/evil", "a/b", ".evil", "a\\b", ""])
def test_group_ids_are_names(name, prepared, tmp_path):
    folder = shutil.copytree(prepared, tmp_path / "gift-i")
    path = folder / "train/metadata.parquet"
    table = pq.read_table(path)
    rows = table.to_pylist()
    rows[0]["group_id"] = name
    pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), path)
    with pytest.raises(ValueError, match="group id"):
        load_gift_i(folder, "train")


# ---- size limits ----


def png_header(width, height):
    """A PNG that says it is this large and holds nothing."""

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def test_pictures_that_say_they_are_huge_are_refused_unread(tmp_path):
    path = tmp_path / "bomb.png"
    path.write_bytes(png_header(60_000, 60_000))
    with pytest.raises(ValueError, match=r"bomb\.png: not a readable image.*exceeds limit"):
        read_image(path)


def test_a_network_size_has_a_limit():
    with pytest.raises(ValueError, match="size 140000x140000: at most"):
        resolve_size("140000x140000")


# ---- no secrets ----


def test_no_token_and_no_home_in_what_a_run_leaves(base_dir, tmp_path, monkeypatch, capsys):
    secret, home = "hf_SecretSecretSecretSecretSecretSecr", "/home/somebody"
    for name in ("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN", "WANDB_API_KEY"):
        monkeypatch.setenv(name, secret)
    monkeypatch.setenv("HOME", home)
    train(arguments(base_dir, write_raw_tree(tmp_path / "raw"), tmp_path / "out", max_steps=1))
    written = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert len(written) > 10
    assert not [path for path in written if secret.encode() in path.read_bytes() or home.encode() in path.read_bytes()]
    said = capsys.readouterr()
    assert secret not in said.out + said.err
    for name in ("gift.json", "README.md"):  # nor where things lie on this machine
        assert str(tmp_path) not in (tmp_path / "out/adapter" / name).read_text()


# ---- fuzz ----

STRANGE = [
    None, True, -1, 0, 1e308, float("nan"), 2**63, 10**30, "", "x", "../..", "/etc/hostname", "\0", "\ud800",
    "é" * 300, [], [None], ["x", 1], [[]], {}, {"a": {}}, {"r": 1},
]  # fmt: skip


def mutated_json(text: str, generator: random.Random) -> bytes:
    """A JSON file with one value replaced, dropped or renamed, or bytes changed, cut or repeated."""
    if generator.random() < 0.6:
        content = json.loads(text)
        place, key = content, generator.choice(list(content))
        while isinstance(place[key], dict) and place[key] and generator.random() < 0.7:
            place, key = place[key], generator.choice(list(place[key]))
        if generator.random() < 0.15:
            del place[key]
        else:
            place[key] = generator.choice(STRANGE)
        return json.dumps(content).encode("utf-8", "surrogatepass")
    return mutated_bytes(text.encode(), generator)


def mutated_bytes(content: bytes, generator: random.Random, within: int | None = None) -> bytes:
    content = bytearray(content)
    within = min(within or len(content), len(content))
    for _ in range(generator.randint(1, 4)):
        at = generator.randrange(within)
        kind = generator.random()
        if kind < 0.5:
            content[at : at + 1] = bytes([generator.randrange(256)])
        elif kind < 0.7:
            content[at : at + 4] = struct.pack(">I", generator.choice([0, 1, 2**31 - 1, 2**31, 2**32 - 1]))
        elif kind < 0.85:
            del content[at : at + generator.randint(1, 64)]
        else:
            content[at:at] = content[at : at + generator.randint(1, 64)]
        if not content:
            break
    return bytes(content)


def one_line_or_fine(action):
    """What `action` raises is a ValueError or OSError of one line."""
    try:
        action()
    except (ValueError, OSError) as error:
        assert str(error) and "\n" not in str(error), str(error)
        return True
    return False


@pytest.mark.parametrize(
    ("name", "read", "loads"),
    [
        ("gift.json", read_gift, 4),
        ("adapter_config.json", read_adapter_config, 16),
        ("preprocessor_config.json", lambda folder: None, 16),
    ],
)
def test_fuzz_adapter_files(name, read, loads, base_dir, adapter, tmp_path):
    """Each is read by itself; the first few also with model and weights."""
    generator = random.Random(name)
    text = (adapter / name).read_text()
    folder = shutil.copytree(adapter, tmp_path / "adapter")
    refused = 0
    for trial in range(FUZZ):
        (folder / name).write_bytes(mutated_json(text, generator))
        refused += one_line_or_fine(lambda: read(folder))
        if trial < loads:
            refused += one_line_or_fine(lambda: DepthModel.from_pretrained(base_dir, folder))
    assert refused


def test_fuzz_metadata(prepared, tmp_path, monkeypatch):
    generator = random.Random("metadata")
    folder = shutil.copytree(prepared, tmp_path / "gift-i")
    path = folder / "train/metadata.parquet"
    table = pq.read_table(path)
    content = path.read_bytes()
    refused = 0
    for trial in range(FUZZ // 3):
        monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / f"cache{trial}")
        if trial % 2:
            path.write_bytes(mutated_bytes(content, generator))
        else:
            rows = table.to_pylist()
            row = generator.choice(rows)
            key = generator.choice(list(row))
            texts = ["", "x", "../x", "scene_0", "\0", "é" * 300, None]
            if isinstance(row[key], list):
                row[key] = generator.choice([None, [], row[key][:1], [*row[key], generator.choice(texts)], texts[:2]])
            else:
                row[key] = generator.choice(texts)
            pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), path)
        refused += one_line_or_fine(lambda: list(load_gift_i(folder, "train")))
    assert refused > FUZZ / 10


def test_fuzz_metadata_in_json_lines(prepared, tmp_path, monkeypatch):
    generator = random.Random("jsonl")
    folder = shutil.copytree(prepared, tmp_path / "gift-i")
    rows = pq.read_table(folder / "train/metadata.parquet").to_pylist()
    (folder / "train/metadata.parquet").unlink()
    refused = 0
    for trial in range(FUZZ // 3):
        monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / f"cache{trial}")
        lines = [json.dumps(row).encode() for row in rows]
        number = generator.randrange(len(lines))
        lines[number] = mutated_json(json.dumps(rows[number]), generator)
        (folder / "train/metadata.jsonl").write_bytes(b"\n".join(lines) + b"\n")
        refused += one_line_or_fine(lambda: list(load_gift_i(folder, "train")))
    assert refused > FUZZ / 10


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tif", "webp", "ppm"])
def test_fuzz_image_headers(suffix, tmp_path):
    generator = random.Random(suffix)
    picture = PilImage.effect_noise((40, 30), 60).convert("RGB")
    exif = picture.getexif()
    exif[PilImage.ExifTags.Base.Orientation] = 6
    buffer = io.BytesIO()
    known = {"jpg": "JPEG", "tif": "TIFF"}
    picture.save(buffer, known.get(suffix, suffix.upper()), **({} if suffix in ("bmp", "ppm") else {"exif": exif}))
    path = tmp_path / f"x.{suffix}"
    refused = 0
    for _ in range(FUZZ):
        path.write_bytes(mutated_bytes(buffer.getvalue(), generator, within=200))
        refused += one_line_or_fine(lambda: read_image(path))
        one_line_or_fine(lambda: open_image(path.read_bytes(), str(path)))
    assert refused > FUZZ / 10
