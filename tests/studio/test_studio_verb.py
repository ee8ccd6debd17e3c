"""`gift-peft studio` before it serves: what kind of folder it is, and the line it ends with where it is none."""

import shutil
from pathlib import Path

import pytest
from helpers.tiny import write_group
from PIL import Image

from gift_peft.cli import main
from gift_peft.prepare import proposals
from gift_peft.studio import server, studio_verb
from gift_peft.studio.studio_verb import kind_of

PREPARED = Path(__file__).parents[1] / "fixtures" / "prepared"


def fails(capsys, *words):
    """The line that it ends with."""
    with pytest.raises(SystemExit) as ended:
        main(["studio", *map(str, words)])
    assert ended.value.code == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_kinds_of_folders(tmp_path):
    write_group(tmp_path / "raw" / "hall", 2, 0)
    (tmp_path / "clips" / "train" / "hall").mkdir(parents=True)
    (tmp_path / "clips" / "train" / "hall" / "clip.MP4").write_bytes(b"")
    (tmp_path / "run" / "adapter").mkdir(parents=True)
    (tmp_path / "run" / "config.yaml").write_text("")
    (tmp_path / "run" / "adapter" / "adapter_config.json").write_text("{}")
    kinds = {name: kind_of(tmp_path / name) for name in ("raw", "clips", "run", "run/adapter")}
    assert kinds == {"raw": "raw", "clips": "raw", "run": "run", "run/adapter": "adapter"}
    assert kind_of(PREPARED) == "prepared"


def test_folders_of_a_wrong_kind_are_told_in_a_line(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert "no groups in it; the studio takes" in fails(capsys, tmp_path / "empty")
    (tmp_path / "code" / "src").mkdir(parents=True)
    (tmp_path / "code" / "src" / "a.py").write_text("")
    assert "none of its folders holds photos or a clip" in fails(capsys, tmp_path / "code")
    shutil.copytree(write_group(tmp_path / "raw" / "hall", 2, 0), tmp_path / "flat")
    shutil.rmtree(tmp_path / "flat" / "masks")
    assert "no groups in it" in fails(capsys, tmp_path / "flat")
    assert "no such folder" in fails(capsys, tmp_path / "nothing")
    assert "no such folder" in fails(capsys, tmp_path / "code" / "src" / "a.py")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("")
    assert "without an adapter yet" in fails(capsys, tmp_path / "run")


def test_what_is_missing_is_told_in_a_line(tmp_path, capsys, monkeypatch):
    write_group(tmp_path / "raw" / "hall", 2, 0)
    monkeypatch.setattr(server, "find_spec", lambda name: None)
    assert 'pip install "gift-peft[studio]"' in fails(capsys, tmp_path / "raw")
    monkeypatch.undo()
    monkeypatch.setattr(server, "check_gradio", lambda: None)
    with server.socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert "cannot be used" in fails(capsys, tmp_path / "raw", "--port", taken.getsockname()[1])


@pytest.mark.parametrize(
    "words",
    [
        *([], ["a", "b"], ["a", "--port=-1"], ["a", "--port", "x"], ["a", "--adapter-scale=1"], ["a", "--mask=m.png"]),
        [str(PREPARED), "--refine=sam2:x"],
    ],
)
def test_wrong_usage_is_2(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["studio", *words])
    assert ended.value.code == 2 and "error:" in capsys.readouterr().err


@pytest.fixture
def opened(monkeypatch, tmp_path):
    """What would be served: the rooms of each start."""
    found = []
    monkeypatch.setattr(server, "check_gradio", lambda: None)
    monkeypatch.setattr(server, "build", lambda rooms, title: found.append(rooms))
    monkeypatch.setattr(server, "serve", lambda *args: None)
    monkeypatch.setenv("GRADIO_TEMP_DIR", "")
    monkeypatch.setenv("GRADIO_ANALYTICS_ENABLED", "")
    return found


def test_each_folder_opens_its_rooms(opened, tmp_path, capsys, monkeypatch):
    models, refiners = [], []
    monkeypatch.setattr(proposals, "load_sam2", refiners.append)
    monkeypatch.setattr(studio_verb, "_compare", lambda args, adapter, temporary: models.append(adapter) or "compare")
    write_group(tmp_path / "raw" / "hall", 2, 0)
    (tmp_path / "run" / "adapter").mkdir(parents=True)
    (tmp_path / "run" / "config.yaml").write_text("")
    (tmp_path / "run" / "adapter" / "adapter_config.json").write_text("{}")
    starts = [
        [tmp_path / "raw"],
        [tmp_path / "raw", "--adapter", "a", "--refine=sam2:x"],
        [tmp_path / "run"],
        [tmp_path / "run" / "adapter"],
        [PREPARED, "--base", "b"],  # without surface targets
    ]
    for words in starts:
        with pytest.raises(SystemExit) as ended:
            main(["studio", "--port=0", *map(str, words)])
        assert ended.value.code == 0
    assert [(bool(one.masks), bool(one.targets), bool(one.compare)) for one in opened] == [
        (True, False, False),
        (True, False, True),
        (False, False, True),
        (False, False, True),
        (False, False, True),
    ]
    assert models == ["a", tmp_path / "run" / "adapter", tmp_path / "run" / "adapter", None]
    assert opened[1].masks.method == "sam2:x" and refiners == ["sam2:x"]
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(["studio", "--port=0", str(PREPARED)])
    assert "gift-peft proxies --base BASE" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("method", "message"),
    [("grabcut", "refine 'grabcut': write sam2:<model id>"), ("sam2:{here}/nothing", "the model cannot be loaded")],
)
def test_what_cannot_refine_is_told_before_it_serves(opened, tmp_path, capsys, method, message):
    write_group(tmp_path / "raw" / "hall", 2, 0)
    with pytest.raises(SystemExit) as ended:
        main(["studio", "--port=0", str(tmp_path / "raw"), "--refine", method.format(here=tmp_path)])
    assert ended.value.code == 1 and not opened
    assert message in capsys.readouterr().err.strip().splitlines()[-1]


def test_a_source_opens_the_capture_room_in_raw_or_a_new_folder(opened, tmp_path, capsys, monkeypatch):
    write_group(tmp_path / "raw" / "hall", 2, 0)
    write_group(tmp_path / "split" / "train" / "hall", 2, 0)
    (tmp_path / "empty").mkdir()
    for name in ("raw", "split", "empty", "new"):
        with pytest.raises(SystemExit) as ended:
            main(["studio", "--port=0", str(tmp_path / name), "--source", "0"])
        assert ended.value.code == 0
        assert opened[-1].capture.source.device == 0 and opened[-1].masks.root == tmp_path / name
    assert not (tmp_path / "new").exists()
    monkeypatch.setattr(opened[-1].capture.__class__, "close", lambda room: ["door: 3 photos"])
    with pytest.raises(SystemExit):
        main(["studio", "--port=0", str(tmp_path / "new"), "--source", "0"])
    assert capsys.readouterr().out == "door: 3 photos\n"
    with pytest.raises(ValueError, match="has no groups yet: take photos"):
        opened[-1].masks.groups()
    with pytest.raises(SystemExit) as ended:
        main(["studio", "--port=0", str(tmp_path / "raw")])
    assert ended.value.code == 0 and opened[-1].capture is None


@pytest.mark.parametrize(
    ("folder", "words", "message"),
    [
        ("notes", ["--source", "0"], "holds something else than groups of photos"),
        (PREPARED, ["--source", "0"], "prepared folder"),
        ("new", ["--source", "nowhere.mp4"], "nowhere.mp4: no such file"),
        ("new", ["--source", "nowhere"], "nowhere: neither a camera's number"),
        ("new", ["--source", "0", "--mask", "m.png"], "m.png"),
        ("new", ["--source", "0", "--mask", "black.png"], "black.png: the mask is empty"),
    ],
)
def test_where_no_photos_can_be_taken_is_told_at_the_start(
    opened, tmp_path, capsys, monkeypatch, folder, words, message
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    Image.new("L", (8, 8)).save("black.png")
    with pytest.raises(SystemExit) as ended:
        main(["studio", "--port=0", str(folder), *words])
    assert ended.value.code == 1 and not opened
    assert message in capsys.readouterr().err.strip().splitlines()[-1]
