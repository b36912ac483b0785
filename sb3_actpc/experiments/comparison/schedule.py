"""From the table to finished runs: which are begun, gone on with, tried again or left alone, in worker processes of this
machine or as tasks of a Ray cluster (extra ``ray``)."""

import json
import multiprocessing
import os
import signal
import socket
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from sb3_actpc.checkpoints import StopSignals, TrainingStopped
from sb3_actpc.demonstrations.recording import Report
from sb3_actpc.experiments.runs import Run, finish_run
from sb3_actpc.experiments.runs.record import CONFIG, is_finished, write_json
from sb3_actpc.utils.extras import import_extra
from sb3_actpc.utils.files import FolderBusy, folder_lock

ERROR, LOG = "error.json", "log.txt"
FINISHED, FAILED, UNFINISHED, NEW = "finished", "failed", "unfinished", "new"
STOPPED, LOST = "stopped", "lost"  # outcomes that leave a run unfinished
MAX_LOSSES = 3  # times that the process of one run may die before the run counts as failed
COMMAND_WAIT = 5.0  # seconds for another command in the same folder to end
WORKER_WAIT = 60.0  # seconds for a worker whose command was killed to save its checkpoint and end
POLL = 0.5  # seconds
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@dataclass(frozen=True)
class Outcome:
    """What has become of a run."""

    # "finished", "failed", "stopped" (by a signal, saved) or "lost" (its process ended without a word)
    status: str
    message: str = ""  # what went wrong, one line


# brings runs to their end until it is told to stop, and yields what it hears of each: None when one is begun, and its outcome
# (or several, where it is tried again)
Engine = Callable[[Sequence[Run], Callable[[], bool]], Iterator[tuple[Run, Outcome | None]]]


def run_comparison(
    runs: Sequence[Run], folder: Path, engine: Engine, retry_failed: bool = False, progress: bool = True
) -> str | None:
    """Bring every run of a table to its end that is not there yet, and with ``retry_failed`` those that failed before. Stopped
    at any moment and called again, it loses no finished run, repeats none, and goes on with the others from their last
    checkpoint. Prints a line for every run that begins or ends; with ``progress``, a terminal also shows a bar.

    :return: name of the signal that stopped it; None where it came to its end
    :raises FolderBusy: when another process works in the folder
    """
    tqdm = import_extra("tqdm", "experiments").tqdm
    with folder_lock(folder, COMMAND_WAIT, print):
        to_do = [run for run in runs if run_status(run.folder) in (NEW, UNFINISHED)]
        if retry_failed:
            to_do = [run for run in runs if run_status(run.folder) != FINISHED]
        n_finished = sum(is_finished(run.folder) for run in runs)
        print(f"{n_finished} runs are done, {len(to_do)} to do")
        for run in to_do:
            (run.folder / ERROR).unlink(missing_ok=True)
        if not to_do:
            return None
        bar = tqdm(initial=n_finished, total=len(runs), unit="run", disable=None if progress else True)
        with bar, StopSignals() as signals:
            for run, outcome in engine(to_do, lambda: signals.received is not None):
                bar.write(_line(run, outcome))
                if outcome is not None and outcome.status == FINISHED:
                    bar.update()
            return signals.received


def _line(run: Run, outcome: Outcome | None) -> str:
    """What is printed of a run that begins or ends."""
    if outcome is None:
        return f"started   {run.label}"
    reason = f": {outcome.message}" if outcome.message else ""
    return f"{outcome.status:9s} {run.label}{reason}"


def run_status(folder: Path) -> str:
    """``"finished"``, ``"failed"``, ``"unfinished"`` or ``"new"``, from a run's folder."""
    files = {"result.json": FINISHED, ERROR: FAILED, CONFIG: UNFINISHED}
    return next((status for name, status in files.items() if (folder / name).is_file()), NEW)


def read_error(folder: Path) -> str:
    """The error that ended the run, one line; empty without one."""
    if not (folder / ERROR).is_file():
        return ""
    return str(json.loads((folder / ERROR).read_text(encoding="utf-8"))["message"])


def execute_run(run: Run, report: Report) -> Outcome:
    """Bring a run to its end in this process, from its newest whole checkpoint where there is one. Raises nothing: an error is
    recorded in the run's ``error.json`` and returned."""
    try:
        with folder_lock(run.folder, WORKER_WAIT, report):
            finish_run(run, report)
    except TrainingStopped as stop:
        return Outcome(STOPPED, str(stop))
    except FolderBusy as error:  # the worker of a killed command makes a clone first, say: the run goes on after it
        return Outcome(LOST, str(error))
    except Exception as error:  # whatever it is, the other runs go on
        message = f"{type(error).__name__}: {' '.join(str(error).split())}"
        with suppress(OSError):  # the disk may be full
            write_json(run.folder / ERROR, {"message": message, "details": traceback.format_exc()})
        return Outcome(FAILED, message)
    return Outcome(FINISHED)


def run_in_processes(
    n_workers: int | None, threads: int, runs: Sequence[Run], is_stopped: Callable[[], bool]
) -> Iterator[tuple[Run, Outcome | None]]:
    """The local engine: each run in a process with its own interpreter, ``n_workers`` at a time, by default as many as there
    are cores for so many threads each. A process saves and ends when it is told to, and when this one dies."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    n_workers = n_workers or max(1, cores // threads)
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, str(threads)))
    context = multiprocessing.get_context("spawn")
    waiting = deque(runs)
    losses = Counter[str]()
    is_told = False
    under_way: dict[Any, tuple[Run, BaseProcess]] = {}  # by the end of a pipe that it speaks into
    try:
        while under_way or (waiting and not is_stopped()):
            while waiting and len(under_way) < n_workers and not is_stopped():
                run = waiting.popleft()
                connection, other_end = context.Pipe(duplex=False)
                process: BaseProcess = context.Process(target=_work, args=(run, other_end))
                process.start()
                other_end.close()
                under_way[connection] = run, process
                yield run, None
            if is_stopped() and not is_told:
                is_told = True
                for _, process in under_way.values():
                    process.terminate()
            for speaking in wait(list(under_way), timeout=POLL):
                run, process = under_way.pop(speaking)
                outcome = _outcome_of(process, speaking)
                if outcome.status in (LOST, STOPPED) and not is_stopped():  # somebody ended the process, not the run
                    losses[run.id] += 1
                    if losses[run.id] < MAX_LOSSES:
                        waiting.appendleft(run)
                    else:
                        outcome = Outcome(FAILED, f"given up after {MAX_LOSSES} times: {outcome.message}")
                        write_json(run.folder / ERROR, {"message": outcome.message})
                yield run, outcome
    finally:
        for _, process in under_way.values():
            process.terminate()


def _outcome_of(process: BaseProcess, connection: Any) -> Outcome:
    """What a process that ends has said of its run; one that was killed says nothing."""
    try:
        outcome: Outcome | None = connection.recv()
    except (EOFError, OSError):
        outcome = None
    process.join()
    number = process.exitcode or 0
    ending = f"signal {-number}: was the memory full?" if number < 0 else f"code {number}: see the run's {LOG}"
    return outcome or Outcome(LOST, f"the process of the run ended with {ending}")


def _work(run: Run, connection: Connection) -> None:
    """In the process of a run: bring it to its end, and say so."""
    getattr(os, "setsid", lambda: None)()  # Ctrl-C is for the command, which tells its workers
    threading.Thread(target=_stop_with_the_command, daemon=True).start()
    run.folder.mkdir(parents=True, exist_ok=True)
    with open(run.folder / LOG, "a", encoding="utf-8") as log:
        for descriptor in (1, 2):  # whatever libraries print goes to the log
            os.dup2(log.fileno(), descriptor)
        outcome = execute_run(run, partial(print, flush=True))
    with suppress(OSError):  # the command was killed: nobody listens
        connection.send(outcome)


def _stop_with_the_command() -> None:
    command = multiprocessing.parent_process()
    assert command is not None
    command.join()
    os.kill(os.getpid(), signal.SIGTERM)


def run_on_ray(
    address: str | None, threads: int, runs: Sequence[Run], is_stopped: Callable[[], bool]
) -> Iterator[tuple[Run, Outcome]]:
    """The engine on the Ray cluster at an address, such as ``"auto"`` or ``"10.0.0.1:6379"``, by default one that is started
    on this machine; Ray schedules the runs. The nodes share this machine's folders (a network file system), where a run whose
    node dies goes on elsewhere. ImportError without Ray, ConnectionError when no cluster answers."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # sends nothing unless the user asks for it
    ray = import_extra("ray", "ray")
    handler = signal.getsignal(signal.SIGTERM)  # Ray would put its own in the place of the command's
    ray.init(address=address or "local", log_to_driver=False, include_dashboard=None if address else False)
    signal.signal(signal.SIGTERM, handler)
    work = ray.remote(num_cpus=threads, max_retries=MAX_LOSSES - 1)(_work_on_node)
    for run in runs:
        run.folder.mkdir(parents=True, exist_ok=True)
    tasks = {work.remote(run.model_copy(update={"output": str(run.folder.absolute())})): run for run in runs}
    is_told = False
    try:
        while tasks:
            if is_stopped() and not is_told:
                is_told = True
                for task in tasks:
                    ray.cancel(task)  # interrupts it
            for task in ray.wait(list(tasks), timeout=POLL)[0]:
                try:
                    outcome = ray.get(task)
                except ray.exceptions.RayError as error:  # it was not begun, or the node, or the process on it, died
                    outcome = Outcome(STOPPED if is_stopped() else LOST, str(error).partition("\n")[0])
                yield tasks.pop(task), outcome
    finally:
        ray.shutdown()


def _work_on_node(run: Run) -> Outcome:
    if not run.folder.is_dir():
        return Outcome(FAILED, f"{socket.gethostname()} does not see {run.folder}: give an --output that all nodes share")
    with open(run.folder / LOG, "a", encoding="utf-8") as log:
        return execute_run(run, lambda line: print(line, file=log, flush=True))
