"""Real faults: a full disk, folders that cannot be written, a killed process, damaged files. Nothing good is lost.

Each ends in one line that says what to do, and the run goes on from there to the same bits.
"""

import ctypes
import os
import shutil
import signal
import subprocess
from contextlib import contextmanager

import datasets
import pytest
from helpers.backbones import metric3d_golden
from helpers.runs import arguments, assert_same_run, run_in_child, run_in_processes, train_again
from helpers.tiny import SIZE
from safetensors.torch import save_file

from gift_peft.files import write_whole
from gift_peft.group_step import GroupStep
from gift_peft.models.convert import convert_metric3d
from gift_peft.training import checkpoints, train
from gift_peft.training.teacher import make_proxies


@pytest.fixture
def disk(tmp_path):
    """A file system of its own, of 16 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=16m", "none", str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("a file system cannot be mounted here (it takes root)")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@contextmanager
def full(disk, left):
    """Inside, only `left` bytes are free."""
    ballast = disk / "ballast"
    usage = os.statvfs(disk)
    ballast.write_bytes(bytes(max(usage.f_bavail * usage.f_frsize - left, 0)))
    yield
    ballast.unlink()


def before_call(number, function, act):
    """`function`, but `act()` comes before its `number`-th call."""
    calls = []

    def wrapped(*args, **kwargs):
        calls.append(args)
        if len(calls) == number:
            act()
        return function(*args, **kwargs)

    return wrapped


def one_line(caught):
    message = str(caught.value)
    assert "\n" not in message
    return message


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# ---- a full disk ----


@pytest.mark.parametrize("left", [4096, 150_000])  # for the first small files, or up to the optimizer's
def test_a_full_disk_while_a_checkpoint_is_written(left, base_dir, tree, whole, disk, monkeypatch):
    args = arguments(base_dir, tree, disk / "out")
    ballast = full(disk, left)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "write_checkpoint", before_call(2, checkpoints.write_checkpoint, ballast.__enter__))
        with pytest.raises(OSError, match="No space left") as caught:
            train(args)
    assert f"{disk}/out/" in one_line(caught)
    assert checkpoints.checkpoint_fault(disk / "out/checkpoint-1") is None
    assert {name for name in names(disk / "out") if name != "adapter"} == {
        "checkpoint-1",
        "config.yaml",
        "metrics.jsonl",
    }
    ballast.__exit__(None, None, None)
    train_again(args)
    assert_same_run(disk / "out", whole)


def test_a_full_disk_while_proxies_are_made(base_dir, tree, disk):
    with full(disk, 20_000):
        with pytest.raises(OSError, match="No space left") as caught:
            make_proxies(base_dir, tree, size=SIZE, proxies_dir=disk / "proxies")
        one_line(caught)
        assert caught.value.filename.endswith(".safetensors")
    made = {path.relative_to(disk): path.read_bytes() for path in disk.rglob("*") if path.is_file()}
    folder = make_proxies(base_dir, tree, size=SIZE, proxies_dir=disk / "proxies")
    assert len(list(folder.rglob("*.safetensors"))) == 3 > len(made)
    assert all(path.suffix == ".safetensors" and (disk / path).read_bytes() == made[path] for path in made)


def test_a_full_disk_keeps_the_old_file(disk):
    path = disk / "metrics.jsonl"
    write_whole(path, "old")
    with full(disk, 4096), pytest.raises(OSError, match=r"No space left.*disk/metrics\.jsonl"):
        write_whole(path, b"x" * 100_000)
    assert path.read_text() == "old" and names(disk) == ["metrics.jsonl"]


def test_a_full_disk_leaves_no_half_converted_model(disk, tmp_path):
    _, weights, config = metric3d_golden()
    save_file({name: value for name, value in weights.items() if ".downsample.1." not in name}, tmp_path / "w")
    with full(disk, 1_000_000):
        with pytest.raises(OSError, match=r"disk/model.*No space left") as caught:
            convert_metric3d(tmp_path / "w", disk / "model", config)
        one_line(caught)
        assert names(disk) == ["ballast"]


# ---- folders that cannot be written ----


@pytest.fixture
def common(base_dir, tree, tmp_path):
    """(base, raw tree, an empty folder)."""
    (tmp_path / "work").mkdir()
    return base_dir, tree, tmp_path / "work"


def obey_permissions():
    """From here on this process of root's heeds the permission bits of files (capset(2); new threads inherit it)."""
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # _LINUX_CAPABILITY_VERSION_3, this thread
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable; then the same for capabilities from 32
    if libc.capget(header, sets) == 0:
        for index in range(3):
            sets[index] &= ~0b110  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
        if libc.capset(header, sets) == 0:
            return
    raise OSError(ctypes.get_errno(), "capabilities could not be dropped")


def as_a_user(work, function):
    """What `function()` raises, as "<class>: <message>", in a process that heeds permissions."""

    def run():
        if os.getuid() == 0:
            obey_permissions()
        datasets.config.HF_DATASETS_CACHE = work / "datasets"
        try:
            function()
        except (ValueError, OSError) as error:
            (work / "error").write_text(f"{type(error).__name__}: {error}")

    assert run_in_child(run) == 0
    error = work / "error"
    return error.read_text() if error.exists() else None


def common_arguments(common, **changes):
    base, raw, work = common
    folders = {"proxies_dir": str(work / "proxies"), "group_cache_dir": str(work / "groups")}
    return arguments(base, raw, changes.pop("out", work / "out"), **folders | changes)


@pytest.mark.parametrize("exists", [False, True])
def test_an_output_folder_that_cannot_be_written(exists, common):
    work = common[2]
    locked = work / "locked"
    locked.mkdir()
    if exists:
        (locked / "out").mkdir()
        (locked / "out").chmod(0o555)
    locked.chmod(0o555)
    message = as_a_user(work, lambda: train(common_arguments(common, out=locked / "out")))
    assert message.startswith("PermissionError: ") and str(locked / "out") in message and "\n" not in message
    assert names(locked) == (["out"] if exists else []) and not (exists and names(locked / "out"))


def test_an_output_folder_that_is_locked_while_the_run_goes_on(common, whole):
    work = common[2]
    args = common_arguments(common)

    def run():
        lock = before_call(2, checkpoints.write_checkpoint, lambda: (work / "out").chmod(0o555))
        checkpoints.write_checkpoint = lock
        train(args)

    message = as_a_user(work, run)
    assert message.startswith("OSError: ") and "could not be written" in message and "checkpoint-2" in message
    (work / "out").chmod(0o755)
    assert checkpoints.checkpoint_fault(work / "out/checkpoint-1") is None
    assert not list((work / "out").glob("*checkpoint-2*"))
    train_again(args)
    assert_same_run(work / "out", whole)


def test_proxies_that_cannot_be_written(common):
    work = common[2]
    (work / "proxies").mkdir()
    (work / "proxies").chmod(0o555)
    message = as_a_user(work, lambda: train(common_arguments(common)))
    assert message.startswith("PermissionError: ") and "`gift-peft proxies --base" in message
    assert names(work / "proxies") == []


# ---- processes that die ----


def test_a_killed_process_is_told_by_the_other_one(base_dir, tree, tmp_path):
    def args(out):
        return arguments(base_dir, tree, tmp_path / out, proxies_dir=str(tmp_path / "proxies"))

    def run(rank):
        if rank == 1:
            kill = before_call(3, GroupStep.accumulate, lambda: os.kill(os.getpid(), signal.SIGKILL))
            GroupStep.accumulate = kill
        try:
            train(args("out"))
        except ConnectionError as error:
            (tmp_path / "told").write_text(str(error))

    assert run_in_processes(lambda rank: train(args("whole"))) == [0, 0]
    assert run_in_processes(run) == [0, -signal.SIGKILL]
    told = (tmp_path / "told").read_text()
    last = tmp_path / "out/checkpoint-2"
    assert "process 0 has lost another process" in told and f"the last checkpoint is {last};" in told
    assert "\n" not in told and "--resume_from_checkpoint latest" in told
    assert run_in_processes(lambda rank: train_again(args("out"))) == [0, 0]
    assert_same_run(tmp_path / "out", tmp_path / "whole")


def test_a_signal_to_one_process_stops_both_with_a_checkpoint(base_dir, tree, tmp_path):
    args = arguments(base_dir, tree, tmp_path / "out", proxies_dir=str(tmp_path / "proxies"))

    def run(rank):
        if rank == 1:
            stop = before_call(2, GroupStep.accumulate, lambda: os.kill(os.getpid(), signal.SIGTERM))
            GroupStep.accumulate = stop
        result = train(args)
        (tmp_path / f"{rank}").write_text(f"{result.signal} {result.step}")

    assert run_in_processes(run) == [0, 0]
    assert {(tmp_path / name).read_text() for name in "01"} == {f"{signal.SIGTERM:d} 2"}
    assert checkpoints.checkpoint_fault(tmp_path / "out/checkpoint-2") is None


# ---- damaged files ----


def test_a_truncated_proxy_stops_a_resumed_run_and_can_be_made_again(base_dir, tree, whole, tmp_path):
    shutil.copytree(tree, tmp_path / "raw")
    shutil.rmtree(tmp_path / "raw/proxies", ignore_errors=True)
    args = arguments(base_dir, tmp_path / "raw", tmp_path / "out", max_steps=2)
    train(args)
    proxy = next((tmp_path / "raw/proxies").rglob("train/scene_1.safetensors"))
    content = proxy.read_bytes()
    proxy.write_bytes(content[: len(content) // 2])
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=rf"damaged proxy {proxy}.*--overwrite") as caught:
        train_again(args, max_steps=-1)
    one_line(caught)
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()} == before
    make_proxies(base_dir, tmp_path / "raw", size=SIZE, overwrite=True)
    assert proxy.read_bytes() == content
    train_again(args, max_steps=-1)
    assert_same_run(tmp_path / "out", whole)


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"a": 1}', "{", '{"../../etc/hostname": "0"}'])
def test_checksums_that_say_too_little_are_a_fault(content, whole, tmp_path):
    folder = shutil.copytree(whole / "checkpoint-4", tmp_path / "checkpoint-4")
    (folder / checkpoints.CHECKSUMS).write_text(content)
    assert checkpoints.checkpoint_fault(folder)


def test_every_file_of_a_checkpoint_is_watched(whole, tmp_path):
    files = [path.relative_to(whole) for path in (whole / "checkpoint-4").rglob("*") if path.is_file()]
    assert len(files) > 8
    for file in files:
        folder = shutil.copytree(whole / "checkpoint-4", tmp_path / file.name / str(len(file.parts)) / "checkpoint-4")
        assert checkpoints.checkpoint_fault(folder) is None
        path = folder.parent / file
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
        assert checkpoints.checkpoint_fault(folder), file
