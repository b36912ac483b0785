"""Runs in processes of this machine, each with its own interpreter."""

import json
import os
import queue
import subprocess
import sys
import threading
from contextlib import suppress

from sb3_actpc.experiments.comparison.engines.base import Event
from sb3_actpc.experiments.comparison.execution import LOG, LOST, STOPPED, Outcome
from sb3_actpc.experiments.runs import Run

SAVING_TIME = 60.0  # seconds that a worker gets to save its checkpoint
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")


class LocalEngine:
    """A process for each run. A process that dies, whatever the reason, takes no other with it; all save and end when this one
    dies.

    :param n_workers: runs at a time; by default the number of usable cores divided by ``threads``
    :param threads: of each run
    """

    def __init__(self, n_workers: int | None = None, threads: int = 1) -> None:
        self.n_workers = max(1, usable_cores() // threads) if n_workers is None else n_workers
        self.threads = threads
        self.workers: dict[str, subprocess.Popen[str]] = {}
        self._events: queue.Queue[Event] = queue.Queue()
        self._is_stopping = False

    def capacity(self) -> int:
        """See :class:`~sb3_actpc.experiments.comparison.engines.Engine`, as for the others."""
        return self.n_workers

    def start(self, run: Run) -> None:
        """Begin, or go on with, a run."""
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
        """News, after some seconds at most."""
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


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _describe_exit(code: int) -> str:
    hint = ": was the memory full?" if code == -9 else f": see the run's {LOG}"
    return f"the process of the run ended with signal {-code}{hint}" if code < 0 else f"it ended with code {code}{hint}"
