"""Where runs are executed: processes of this machine, or tasks of a Ray cluster (extra ``ray``). One function for each."""

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from sb3_actpc.experiments.comparison.execution import ERROR, FAILED, LOG, LOST, STOPPED, Outcome, execute_run, write_error
from sb3_actpc.experiments.runs import Run
from sb3_actpc.utils.extras import import_extra

ENGINES = ("local", "ray")
SAVING_TIME, CONNECTION_TIME, POLL = 60.0, 10.0, 0.5  # seconds; the first is for a stopped run to save its checkpoint
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@dataclass(frozen=True)
class Engine:
    """How runs are executed."""

    # brings a run to its end in another process; it saves and ends when the event is set; the function is told its steps
    execute: Callable[[Run, threading.Event, Callable[[int], None]], Outcome]
    capacity: Callable[[], int]  # how many runs can be executed at a time, now
    close: Callable[[], None] = lambda: None  # leaves nothing running


def make_engine(name: str, n_workers: int | None, threads: int, address: str | None = None) -> Engine:
    """One of ``ENGINES``, for ``n_workers`` runs at a time of so many threads (by default as many as there are cores for);
    ``address`` is a Ray cluster's, such as ``"auto"`` or ``"10.0.0.1:6379"``, by default one is started on this machine.
    ValueError for a wrong argument, ImportError without Ray, ConnectionError when no cluster answers at the address."""
    if name not in ENGINES:
        raise ValueError(f"engine={name!r} is unknown: choose one of {', '.join(ENGINES)}")
    if n_workers is not None and n_workers < 1:
        raise ValueError(f"workers={n_workers} must be at least 1: give the number of runs at a time")
    if name == "ray":
        return _ray_engine(n_workers, threads, address)
    if address is not None:
        raise ValueError(f"address={address!r} is of no use to the local engine: add --engine ray, or leave it out")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Engine(partial(execute_in_process, threads), lambda: n_workers or max(1, cores // threads))


def execute_in_process(threads: int, run: Run, stop: threading.Event, on_steps: Callable[[int], None]) -> Outcome:
    """Execute a run in a process with its own interpreter. The process saves and ends when its input closes: upon ``stop``,
    and when this process dies."""
    run.folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "sb3_actpc.experiments.comparison.worker"]
    environment = {**os.environ, **dict.fromkeys(_THREAD_VARIABLES, str(threads))}
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environment}
    with open(run.folder / LOG, "a", encoding="utf-8") as log:
        # a session of its own: Ctrl-C is for the command, which tells its workers
        worker = subprocess.Popen(command, stderr=log, start_new_session=True, **pipes)
    assert worker.stdin is not None and worker.stdout is not None
    threading.Thread(target=_stop_worker, args=(worker, stop), daemon=True).start()
    with suppress(BrokenPipeError, ValueError):  # it died or was stopped at once; its end says so
        print(run.model_dump_json(), file=worker.stdin, flush=True)
    outcome = None
    for line in worker.stdout:
        with suppress(ValueError):  # a line that the worker did not live to finish
            message = json.loads(line)
            if "steps" in message:
                on_steps(message["steps"])
            else:
                outcome = Outcome(message["status"], message["message"])
    code = worker.wait()
    if outcome is None and stop.is_set():
        return Outcome(STOPPED)
    ending = f"signal {-code}: was the memory full?" if code < 0 else f"code {code}: see the run's {LOG}"
    return outcome or Outcome(LOST, f"the process of the run ended with {ending}")


def _stop_worker(worker: "subprocess.Popen[str]", stop: threading.Event) -> None:
    """Close the worker's input when told, and kill it if it does not end."""
    stop.wait()
    assert worker.stdin is not None
    with suppress(OSError):
        worker.stdin.close()
    try:
        worker.wait(timeout=SAVING_TIME)
    except subprocess.TimeoutExpired:
        worker.kill()


def _ray_engine(n_workers: int | None, threads: int, address: str | None) -> Engine:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # sends nothing unless the user asks for it
    ray = import_extra("ray", "ray")
    is_mine = not ray.is_initialized()
    if is_mine:
        _check_address(address)
        # None might find the file of a cluster that has died, and wait for it
        options = {"address": "local", "include_dashboard": False} if address is None else {"address": address}
        ray.init(log_to_driver=False, **options)

    def capacity() -> int:
        fitting = int(ray.cluster_resources().get("CPU", 0)) // threads
        return max(1, fitting if n_workers is None else min(fitting, n_workers))

    return Engine(partial(execute_on_ray, threads), capacity, ray.shutdown if is_mine else lambda: None)


def execute_on_ray(threads: int, run: Run, stop: threading.Event, on_steps: Callable[[int], None]) -> Outcome:
    """Execute a run as a task of the Ray cluster that this process has joined; steps are not told. The nodes share this
    machine's folders (a network file system), where a run whose node dies continues elsewhere. ConnectionError when the
    cluster's head has died."""
    ray = import_extra("ray", "ray")
    run.folder.mkdir(parents=True, exist_ok=True)
    run = run.model_copy(update={"output": str(run.folder.absolute())})
    task = ray.remote(num_cpus=threads, max_retries=0)(_execute_on_node).remote(run.model_dump_json())
    head, is_told = ray.get_runtime_context().gcs_address, False
    while not ray.wait([task], timeout=POLL)[0]:
        _check_address(head)  # Ray would wait for a minute and end this process
        if stop.is_set() and not is_told:
            ray.cancel(task)  # interrupts it
            is_told = True
    try:
        outcome = Outcome(*ray.get(task))
    except ray.exceptions.RayError as error:  # the node, or the process on it, died
        first_line = (str(error).strip() or type(error).__name__).splitlines()[0]
        return Outcome(STOPPED if stop.is_set() else LOST, first_line)
    if outcome.status == FAILED and not (run.folder / ERROR).is_file():
        write_error(run.folder, outcome.message)
    return outcome


def _execute_on_node(job: str) -> tuple[str, str]:
    run = Run.model_validate_json(job)
    if not run.folder.is_dir():
        return FAILED, f"{socket.gethostname()} does not see {run.folder}: give an --output that all nodes share"
    with open(run.folder / LOG, "a", encoding="utf-8") as log:
        outcome = execute_run(run, lambda line: print(line, file=log, flush=True), lambda steps: None)
    return outcome.status, outcome.message


def _check_address(address: str | None) -> None:
    """ConnectionError when nobody answers at ``host:port``, for which Ray itself would try for minutes."""
    host, separator, port = (address or "").rpartition(":")
    if not separator or "/" in host or not port.isdigit():  # "auto", or a URL of Ray's
        return
    try:
        socket.create_connection((host, int(port)), timeout=CONNECTION_TIME).close()
    except OSError as error:
        fix = "give that of `ray start --head`, or leave it out to start one; the same command goes on"
        raise ConnectionError(f"no Ray cluster answers at address={address!r} ({error.strerror or error}): {fix}") from error
