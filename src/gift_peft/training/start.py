"""Before the first update: is this run possible, may it write where it is told, and does it go on with another?

Everything that can be known to fail fails here, before a model is loaded.
"""

import math
import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import psutil
import torch
from accelerate import Accelerator, PartialState
from accelerate.state import AcceleratorState
from accelerate.utils import DistributedDataParallelKwargs, ProjectConfiguration, parse_flag_from_env

from gift_peft.evaluation.booster_scenes import find_booster
from gift_peft.files import existing_folder, reason
from gift_peft.training.arguments import GiftTrainingArguments
from gift_peft.training.checkpoints import find_checkpoint, last_complete, remove_leftovers
from gift_peft.training.precision import choose_precision
from gift_peft.training.run_folder import check_folder, delete_run, holds_run, write_config
from gift_peft.training.upload import check_push

# How launchers tell a process how many there are: torchrun, Open MPI, MPICH and Intel MPI, MVAPICH, srun.
WORLD_SIZES = ("WORLD_SIZE", "OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE", "SLURM_STEP_NUM_TASKS")
LONGEST_WAIT = timedelta(hours=12)  # of one process for another; one that dies is noticed by torchrun, or at once


def make_accelerator(args: GiftTrainingArguments) -> Accelerator:
    """Device, processes, mixed precision (`choose_precision`) and tracker."""
    # Before the first update one process may work for long while the others wait: digests and proxies of a large set.
    state = PartialState(cpu=parse_flag_from_env("ACCELERATE_USE_CPU"), timeout=LONGEST_WAIT)
    precision = choose_precision(args.mixed_precision, state.device, state.print)
    if args.report_to != "none" and find_spec(args.report_to) is None:
        raise ValueError(f"report_to: {args.report_to} is not installed; pip install gift-peft[{args.report_to}]")
    tell_missing_processes(PartialState().num_processes)
    AcceleratorState._reset_state()  # an earlier run of this process (a notebook) may have had another precision
    logs = Path(args.output_dir) / "logs"
    return Accelerator(
        mixed_precision=precision,
        log_with=None if args.report_to == "none" else args.report_to,
        project_config=ProjectConfiguration(project_dir=args.output_dir, logging_dir=str(logs)),
        # Of target: surface alone. A head may hold weights that no prediction needs; buffers never change.
        kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=True, broadcast_buffers=False)],
    )


def start_tracker(args: GiftTrainingArguments, accelerator: Accelerator) -> None:
    """Begin the record of this run at the tracker that `report_to` names, if any; files go to `logs`.

    Raises ValueError with the tracker's own reason: no account, no network.
    """
    if args.report_to == "none":
        return
    logs = Path(args.output_dir) / "logs"
    if accelerator.is_main_process:
        logs.mkdir(parents=True, exist_ok=True)  # wandb writes elsewhere if its folder is not there
    options = {"wandb": {"dir": str(logs), "name": Path(args.output_dir).resolve().name}}
    try:
        accelerator.init_trackers("gift-peft", {key: str(value) for key, value in asdict(args).items()}, options)
    except Exception as error:  # each tracker has errors of its own
        more = "; WANDB_MODE=offline records without an account" if args.report_to == "wandb" else ""
        raise ValueError(f"report_to: {args.report_to} did not start ({reason(error)}){more}") from None


def tell_missing_processes(num_processes: int) -> None:
    """Warn in one line where the launcher announces more processes than there are, with the command that starts them.

    `accelerate launch --cpu --num_processes 2` starts the second by MPI alone: without it, it sets an address for
    processes to meet at and runs one. Other launchers tell each process how many there are.
    """
    told = [int(os.environ[name]) for name in WORLD_SIZES if os.environ.get(name, "").isdigit()]
    announced = max(told, default=1)
    if not told and "MASTER_ADDR" in os.environ and "ACCELERATE_MIXED_PRECISION" in os.environ:
        announced = _asked_of_accelerate()
    if announced <= num_processes:
        return
    count = f"{announced} processes" if announced < math.inf else "several processes"
    number = str(announced) if announced < math.inf else "N"
    program, *words = sys.argv
    if Path(program).name == "gift-peft" or Path(program).parent.name == "training":
        program, words = "-m gift_peft.training", words[1:] if words[:1] == ["train"] else words
    cpu = "ACCELERATE_USE_CPU=true " if parse_flag_from_env("ACCELERATE_USE_CPU") else ""
    command = f"{cpu}torchrun --nproc_per_node {number} {program} {shlex.join(words)}".strip()
    text = f"the launcher announces {count}, and {num_processes} is at work; start them with  {command}"
    print(f"gift-peft: warning: {text}", file=sys.stderr)


def _asked_of_accelerate() -> float:
    """The `--num_processes` of the `accelerate launch` above this process; infinite where it is not on its line."""
    try:
        words = [word.replace("-", "_") for word in psutil.Process().parent().cmdline()]
        value = words[words.index("__num_processes") + 1]
    except (psutil.Error, AttributeError, ValueError, IndexError):
        return math.inf
    return int(value) if value.isdigit() else math.inf


def check_run(args: GiftTrainingArguments, accelerator: Accelerator, prepare: bool = True) -> tuple[Path, Path | None]:
    """(output folder, checkpoint to go on from or None). Changes nothing but leftovers of a killed run.

    Without `prepare` not even those are removed, nor the output folder made.

    Raises ValueError if the folder holds a run that the arguments neither resume nor overwrite, or files in the run's
    way that no run wrote, OSError if it cannot be written, and either for a bad Booster root.
    """
    output = Path(args.output_dir)
    check_push(args)
    if output.exists() and not output.is_dir():
        raise ValueError(f"output_dir: {output} is a file")
    if prepare and accelerator.is_main_process and output.is_dir():
        remove_leftovers(output)
    accelerator.wait_for_everyone()
    checkpoint = None
    if args.resume_from_checkpoint:
        warn = print if accelerator.is_main_process else lambda text: None
        checkpoint = find_checkpoint(output, args.resume_from_checkpoint, warn)
        if checkpoint is None and (output / "adapter-last").exists():
            raise ValueError(f"resume_from_checkpoint: the run in {output} has ended and its checkpoints are gone")
        if checkpoint is None:
            warn(f"no checkpoint in {output} yet: starting from the beginning")
    elif not args.overwrite_output_dir and holds_run(output):
        raise ValueError(
            f"output_dir: {output} already holds a run; --resume_from_checkpoint latest goes on with it, "
            "--overwrite_output_dir deletes it"
        )
    check_folder(output, args)
    if prepare:
        output.mkdir(parents=True, exist_ok=True)
    place = existing_folder(output)
    if not os.access(place, os.W_OK):
        raise PermissionError(f"output_dir: {output} cannot be written")
    if args.booster_root is not None:
        find_booster(args.booster_root)
    accelerator.wait_for_everyone()  # nobody writes before everybody has looked
    return output, checkpoint


def claim_folder(args: GiftTrainingArguments, accelerator: Accelerator, fresh: bool) -> None:
    """Write config.yaml, in a `fresh` run after deleting an earlier one. For when all checks are done."""
    if accelerator.is_main_process:
        if fresh:
            delete_run(Path(args.output_dir))
        write_config(Path(args.output_dir), args)
    accelerator.wait_for_everyone()


@contextmanager
def stop_signals() -> Iterator[SimpleNamespace]:
    """Inside, a signal to stop is noted in `.signum` (else 0); a second SIGINT interrupts.

    SIGINT is Ctrl-C, SIGTERM and SIGUSR1 (`sbatch --signal`) come from clusters, SIGHUP from a terminal that closes;
    nohup has that one ignored, and it stays so.
    """
    stop = SimpleNamespace(signum=0)

    def note(signum, frame):
        if stop.signum and signum == signal.SIGINT:
            raise KeyboardInterrupt
        stop.signum = signum
        # Not print: the signal may have come in the middle of one.
        os.write(2, b"\nStopping after this update; Ctrl-C again stops at once, without a checkpoint\n")

    if threading.current_thread() is not threading.main_thread():
        yield stop  # Python delivers signals to the main thread only
        return
    names = [name for name in ("SIGINT", "SIGTERM", "SIGUSR1", "SIGHUP") if hasattr(signal, name)]  # Windows lacks two
    wanted = [getattr(signal, name) for name in names]
    if "SIGHUP" in names and signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        wanted.remove(signal.SIGHUP)
    before = {signum: signal.signal(signum, note) for signum in wanted}
    try:
        yield stop
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


def agree(signum: int, accelerator: Accelerator) -> int:
    """The signal to stop by, if any process has received one, on all of them."""
    if accelerator.num_processes == 1:
        return signum
    received = accelerator.gather(torch.full((1,), signum, device=accelerator.device))
    return int(received.max())


class Interrupted(Exception):
    """A signal has come in the middle of a validation."""


@contextmanager
def tell_lost_processes(accelerator: Accelerator, output: Path) -> Iterator[None]:
    """Inside, ConnectionError with the last checkpoint where another process of the run has died (killed, crashed).

    The backend notices when it next waits for that process, and says so as a RuntimeError of several lines.
    """
    try:
        yield
    except RuntimeError as error:
        if accelerator.num_processes == 1:
            raise
        if not isinstance(error, torch.distributed.DistError) and "gloo" not in str(error):
            raise
        raise ConnectionError(
            f"process {accelerator.process_index} has lost another process of this run, see what that one says; "
            f"{last_complete(output)}; the same command with --resume_from_checkpoint latest goes on with it"
        ) from error
