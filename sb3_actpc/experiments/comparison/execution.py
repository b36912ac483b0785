"""One run of a comparison in the present process: begun, gone on with, or found finished; and what came of it."""

import errno
import json
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback

from sb3_actpc.checkpoints import TrainingStopped
from sb3_actpc.experiments.runs import Run, finish_run
from sb3_actpc.experiments.runs.record import CONFIG, RESULT, read_result, write_result
from sb3_actpc.utils.files import FolderBusy, atomic_write, folder_lock

ERROR, LOG = "error.json", "log.txt"
FINISHED, FAILED, UNFINISHED, NEW = "finished", "failed", "unfinished", "new"
STOPPED, LOST, DISK_FULL = "stopped", "lost", "disk full"  # outcomes that leave a run unfinished
_FULL = (errno.ENOSPC, errno.EDQUOT)
LOCK_WAIT = 60.0  # seconds for a worker whose command was killed to save its checkpoint and end
REPORT_INTERVAL = 1.0  # seconds between two reports of the steps done


@dataclass(frozen=True)
class Outcome:
    """What has become of a run."""

    # "finished", "failed", "disk full", "stopped" (by a signal, saved), "lost" (its process ended without a word, or found
    # another at work)
    status: str
    message: str = ""  # what went wrong, one line


def is_disk_full(error: Exception) -> bool:
    """Whether the disk, or the user's share of it, is full."""
    return isinstance(error, OSError) and error.errno in _FULL


def run_status(folder: Path) -> str:
    """``"finished"``, ``"failed"``, ``"unfinished"`` or ``"new"``, from a run's folder."""
    with suppress(FileNotFoundError, ValueError):
        read_result(folder)
        return FINISHED
    if (folder / ERROR).is_file():
        return FAILED
    return UNFINISHED if (folder / CONFIG).is_file() else NEW


def read_error(folder: Path) -> str:
    """The error that ended the run, one line; empty without one."""
    try:
        return str(json.loads((folder / ERROR).read_text(encoding="utf-8"))["message"])
    except FileNotFoundError:
        return ""
    except (ValueError, KeyError, TypeError, OSError):
        return f"{ERROR} cannot be read"


def write_error(folder: Path, message: str, details: str = "") -> None:
    """Record in one line, with details on where it came from, that a run has failed."""
    with atomic_write(folder / ERROR, "w") as file:
        json.dump({"message": message, "details": details}, file, indent=2)


def repair_result(folder: Path, report: Callable[[str], None]) -> None:
    """Write a damaged ``result.json`` again from the run's other files, or remove it, so that the run goes on."""
    if run_status(folder) == FINISHED or not (folder / RESULT).is_file():
        return
    mend = "written again from the run's other files"
    try:
        write_result(folder)
    except (FileNotFoundError, ValueError):
        (folder / RESULT).unlink()
        mend = "removed, the run goes on from its last checkpoint"
    report(f"{folder / RESULT} is damaged: {mend}")


def execute_run(run: Run, report: Callable[[str], None], on_steps: Callable[[int], None]) -> Outcome:
    """Bring a run to its end, from its newest whole checkpoint where there is one, telling the steps done about once a
    second. Raises nothing: an error is recorded in the run's ``error.json`` and returned."""
    try:
        with folder_lock(run.folder, LOCK_WAIT, report):
            (run.folder / ERROR).unlink(missing_ok=True)
            if run_status(run.folder) != FINISHED:
                finish_run(run, report, [step_watch(on_steps)])
    except TrainingStopped as stop:
        return Outcome(STOPPED, str(stop))
    except FolderBusy as error:  # the worker of a killed command makes a clone first, say: the run goes on after it
        return Outcome(LOST, str(error))
    except Exception as error:  # whatever it is, the other runs go on
        return _failure(run.folder, error)
    return Outcome(FINISHED)


def _failure(folder: Path, error: Exception) -> Outcome:
    message = " ".join(str(error).split()) or type(error).__name__
    if is_disk_full(error):
        return Outcome(DISK_FULL, message)
    try:
        write_error(folder, f"{type(error).__name__}: {message}", traceback.format_exc())
    except OSError as second:
        if is_disk_full(second):
            return Outcome(DISK_FULL, str(second))
    return Outcome(FAILED, f"{type(error).__name__}: {message}")


def step_watch(on_steps: Callable[[int], None]) -> BaseCallback:
    """A callback that tells the environment steps done, at most once in ``REPORT_INTERVAL`` seconds."""
    last = -REPORT_INTERVAL

    def watch(names: dict[str, Any], _: dict[str, Any]) -> bool:
        nonlocal last
        if time.monotonic() - last >= REPORT_INTERVAL:
            last = time.monotonic()
            on_steps(names["self"].num_timesteps)
        return True

    return ConvertCallback(watch)
