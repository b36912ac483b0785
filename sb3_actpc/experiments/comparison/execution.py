"""One run of a comparison in the present process: begun, gone on with, or found finished; and what came of it."""

from __future__ import annotations

import errno
import json
import shutil
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_actpc.checkpoints import DamagedCheckpoint, TrainingStopped, list_bundles
from sb3_actpc.experiments.comparison.lock import folder_lock
from sb3_actpc.experiments.comparison.run_table import PlannedRun
from sb3_actpc.experiments.runs import resume_run, train_run
from sb3_actpc.experiments.runs.record import CONFIG, RESULT, read_config, read_result, write_result
from sb3_actpc.experiments.runs.run import CHECKPOINTS
from sb3_actpc.utils.files import atomic_write

ERROR, LOG = "error.json", "log.txt"
FINISHED, FAILED, UNFINISHED, NEW = "finished", "failed", "unfinished", "new"
STOPPED, LOST, DISK_FULL = "stopped", "lost", "disk full"  # outcomes that leave a run unfinished
_FULL = (errno.ENOSPC, errno.EDQUOT)
LOCK_WAIT = 60.0  # seconds for a worker whose command was killed to save its checkpoint and end
REPORT_INTERVAL = 1.0  # seconds between two reports of the steps done


@dataclass(frozen=True)
class Outcome:
    """
    :param status: ``"finished"``, ``"failed"``, ``"stopped"`` (by a signal, saved), ``"lost"`` (the process ended without a
        word) or ``"disk full"``
    :param message: what went wrong, one line
    """

    status: str
    message: str = ""


def is_disk_full(error: Exception) -> bool:
    """
    :param error: any
    :return: whether the disk, or the user's share of it, is full
    """
    return isinstance(error, OSError) and error.errno in _FULL


def run_status(folder: Path) -> str:
    """
    :param folder: run folder
    :return: ``"finished"``, ``"failed"``, ``"unfinished"`` or ``"new"``
    """
    try:
        read_result(folder)
    except (FileNotFoundError, ValueError):
        pass
    else:
        return FINISHED
    if (folder / ERROR).is_file():
        return FAILED
    return UNFINISHED if (folder / CONFIG).is_file() else NEW


def read_error(folder: Path) -> str:
    """
    :param folder: run folder
    :return: the error that ended the run, one line; empty without one
    """
    try:
        return str(json.loads((folder / ERROR).read_text(encoding="utf-8"))["message"])
    except FileNotFoundError:
        return ""
    except (ValueError, KeyError, TypeError, OSError):
        return f"{ERROR} cannot be read"


def write_error(folder: Path, message: str, details: str = "") -> None:
    """Record that a run has failed.

    :param folder: run folder
    :param message: one line
    :param details: where the error came from
    :raises OSError: when it cannot be written
    """
    with atomic_write(folder / ERROR, "w") as file:
        json.dump({"message": message, "details": details}, file, indent=2)


def repair_result(folder: Path, report: Callable[[str], None]) -> None:
    """Write a damaged ``result.json`` again from the run's other files, or remove it, so that the run goes on.

    :param folder: run folder
    :param report: given a line when there is something to repair
    :raises OSError: when the folder cannot be written
    """
    try:
        read_result(folder)
        return
    except FileNotFoundError:
        return
    except ValueError as error:
        damage = str(error)
    try:
        write_result(folder)
    except (FileNotFoundError, ValueError):
        (folder / RESULT).unlink()
        report(f"{damage}: removed, the run goes on from its last checkpoint")
    else:
        report(f"{damage}: written again from the run's other files")


def execute_run(run: PlannedRun, report: Callable[[str], None], on_steps: Callable[[int], None]) -> Outcome:
    """Bring a run to its end, from its newest whole checkpoint where there is one. Raises nothing: an error is recorded in
    the run's ``error.json`` and returned.

    :param run: row of the table
    :param report: given lines of text
    :param on_steps: given the environment steps done so far, about once a second
    :return: what came of it
    """
    try:
        with folder_lock(run.folder, LOCK_WAIT, report):
            (run.folder / ERROR).unlink(missing_ok=True)
            if run_status(run.folder) != FINISHED:
                _train(run, report, StepWatch(on_steps))
    except TrainingStopped as stop:
        return Outcome(STOPPED, str(stop))
    except Exception as error:  # whatever it is, the other runs go on
        return _failure(run.folder, error)
    return Outcome(FINISHED)


def _train(run: PlannedRun, report: Callable[[str], None], watch: StepWatch) -> None:
    checkpoints = run.folder / CHECKPOINTS
    if not _has_config(run.folder, report):
        shutil.rmtree(checkpoints, ignore_errors=True)
    if list_bundles(checkpoints):
        try:
            resume_run(run.folder, report, progress=False, callbacks=[watch])
            return
        except DamagedCheckpoint as error:
            report(f"{error}: the run starts again")
            shutil.rmtree(checkpoints)
    train_run(run.config, report, [watch])


def _has_config(folder: Path, report: Callable[[str], None]) -> bool:
    try:
        read_config(folder)
    except FileNotFoundError:
        return False
    except ValueError as error:
        report(f"{error}: the run starts again")
        (folder / CONFIG).unlink()
        return False
    return True


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


class StepWatch(BaseCallback):
    """Tells how far a training is.

    :param on_steps: given the environment steps done, at most once in ``REPORT_INTERVAL`` seconds, and at the end
    """

    def __init__(self, on_steps: Callable[[int], None]) -> None:
        super().__init__()
        self.on_steps = on_steps
        self._last = 0.0

    def checkpoint_state(self) -> dict[str, Any]:
        """Nothing: the clock of another process says nothing."""
        return {}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """:param state: nothing"""

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now - self._last >= REPORT_INTERVAL:
            self._last = now
            self.on_steps(self.num_timesteps)
        return True

    def _on_training_end(self) -> None:
        self.on_steps(self.num_timesteps)
