"""Where runs are executed: what every engine does, and processes of this machine, each with its own interpreter."""

import json
import os
import queue
import subprocess
import sys
import threading
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass

from sb3_actpc.experiments.comparison.execution import LOG, LOST, STOPPED, Outcome
from sb3_actpc.experiments.runs import Run

SAVING_TIME = 60.0  # seconds that a worker gets to save its checkpoint
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@dataclass(frozen=True)
class Event:
    """News of a run: how many steps it has done, or, where there is an outcome, that it has ended."""

    run_id: str
    steps: int | None = None
    outcome: Outcome | None = None


class Engine(ABC):
    """Executes runs, each in a process of its own with :func:`~sb3_actpc.experiments.comparison.execution.execute_run`."""

    @abstractmethod
    def capacity(self) -> int:
        """How many runs can be executed at a time, now."""

    @abstractmethod
    def start(self, run: Run) -> None:
        """Begin, or go on with, a run that is not under way."""

    @abstractmethod
    def poll(self, timeout: float) -> list[Event]:
        """What has happened since the last call, waiting for it some seconds; each run that was started ends in exactly one
        event with an outcome."""

    @abstractmethod
    def stop(self) -> None:
        """Ask every run under way to save a checkpoint and end; their ends still come as events."""

    @abstractmethod
    def close(self) -> None:
        """Leave nothing running."""


class LocalEngine(Engine):
    """A process for each run, at most ``n_workers`` at a time, by default as many as there are usable cores for their
    ``threads``. A process that dies, whatever the reason, takes no other with it; all save and end when this one dies."""

    def __init__(self, n_workers: int | None = None, threads: int = 1) -> None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self.n_workers = max(1, cores // threads) if n_workers is None else n_workers
        self.threads = threads
        self.workers: dict[str, subprocess.Popen[str]] = {}
        self._events: queue.Queue[Event] = queue.Queue()
        self._is_stopping = False

    def capacity(self) -> int:
        return self.n_workers

    def start(self, run: Run) -> None:
        run.folder.mkdir(parents=True, exist_ok=True)
        environment = {**os.environ, **dict.fromkeys(_THREAD_VARIABLES, str(self.threads))}
        with open(run.folder / LOG, "a", encoding="utf-8") as log:
            worker = subprocess.Popen(
                [sys.executable, "-m", "sb3_actpc.experiments.comparison.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=environment,
                text=True,
                start_new_session=True,  # Ctrl-C is for the command, which tells its workers
            )
        assert worker.stdin is not None
        with suppress(BrokenPipeError):  # it died at once; its end says so
            print(run.model_dump_json(), file=worker.stdin, flush=True)
        self.workers[run.id] = worker
        threading.Thread(target=self._listen, args=(run.id, worker), daemon=True).start()

    def poll(self, timeout: float) -> list[Event]:
        events = []
        try:
            events.append(self._events.get(timeout=timeout))
            while True:
                events.append(self._events.get_nowait())
        except queue.Empty:
            return events

    def stop(self) -> None:
        """Close the workers' input, upon which they save and end."""
        self._is_stopping = True
        for worker in list(self.workers.values()):
            assert worker.stdin is not None
            worker.stdin.close()

    def close(self) -> None:
        """Stop what is still there, and kill what does not end."""
        self.stop()
        for worker in list(self.workers.values()):
            try:
                worker.wait(timeout=SAVING_TIME)
            except subprocess.TimeoutExpired:
                worker.kill()
                worker.wait()

    def _listen(self, run_id: str, worker: subprocess.Popen[str]) -> None:
        """Pass on what a worker says, until it ends."""
        outcome = None
        assert worker.stdout is not None
        for line in worker.stdout:
            try:
                message = json.loads(line)
            except ValueError:  # a line that the worker did not live to finish
                continue
            if "steps" in message:
                self._events.put(Event(run_id, steps=message["steps"]))
            else:
                outcome = Outcome(message["status"], message["message"])
        code = worker.wait()
        self.workers.pop(run_id)
        if outcome is None:
            outcome = Outcome(STOPPED) if self._is_stopping else Outcome(LOST, _describe_exit(code))
        self._events.put(Event(run_id, outcome=outcome))


def _describe_exit(code: int) -> str:
    hint = ": was the memory full?" if code == -9 else f": see the run's {LOG}"
    return f"the process of the run ended with signal {-code}{hint}" if code < 0 else f"it ended with code {code}{hint}"
