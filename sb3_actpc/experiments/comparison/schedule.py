"""From the table to finished runs: which are begun, gone on with, tried again or left alone."""

import queue
import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from sb3_actpc.checkpoints import StopSignals
from sb3_actpc.experiments.comparison import execution
from sb3_actpc.experiments.comparison.display import Display
from sb3_actpc.experiments.comparison.engines import Engine
from sb3_actpc.experiments.comparison.execution import FAILED, FINISHED, Outcome, is_disk_full, run_status
from sb3_actpc.experiments.runs import Run
from sb3_actpc.utils.files import folder_lock

MAX_LOSSES = 3  # times that the process of one run may die before the run counts as failed
LOCK_WAIT = 5.0  # seconds for another command in the same folder to end
POLL = 0.5  # seconds


@dataclass
class Summary:
    """What a command has come to."""

    finished: list[Run] = field(default_factory=list)  # the ones done before among them
    failed: list[tuple[Run, str]] = field(default_factory=list)  # now or before, with their errors
    unfinished: list[Run] = field(default_factory=list)  # not begun, or not brought to their end
    stopped_by: str | None = None  # name of the signal that ended the command, or ``"disk full"``
    message: str = ""  # of the full disk


def run_comparison(
    runs: Sequence[Run],
    folder: Path,
    make_engine: Callable[[], Engine],
    display: Display,
    retry_failed: bool = False,
) -> Summary:
    """Bring every run of a table to its end that is not there yet, and with ``retry_failed`` those that failed before. Stopped
    at any moment and called again, it loses no finished run, repeats none, and goes on with the others from their last
    checkpoint. ``make_engine`` makes what executes the runs; it is not called when there is nothing to do. FolderBusy when
    another process works in the folder, OSError when it cannot be written."""
    with folder_lock(folder, LOCK_WAIT, display.line):
        for run in runs:
            execution.repair_result(run.folder, display.line)
        left_alone = (FINISHED,) if retry_failed else (FINISHED, FAILED)
        to_do = [run for run in runs if run_status(run.folder) not in left_alone]
        display.begin(to_do, sum(run_status(run.folder) == FINISHED for run in runs))
        summary = Summary()
        if to_do:
            _Scheduler(make_engine(), display, to_do, summary).run()
        ends = [(run, run_status(run.folder)) for run in runs]
        summary.finished = [run for run, status in ends if status == FINISHED]
        summary.failed = [(run, execution.read_error(run.folder)) for run, status in ends if status == FAILED]
        summary.unfinished = [run for run, status in ends if status not in (FINISHED, FAILED)]
        return summary


class _Scheduler:
    """Keeps an engine busy: a thread waits for each run under way, and puts what it hears of it into a queue."""

    def __init__(self, engine: Engine, display: Display, runs: Sequence[Run], summary: Summary) -> None:
        self.engine, self.display, self.summary = engine, display, summary
        self.waiting = deque(runs)
        self.under_way: dict[str, threading.Thread] = {}
        self.losses: Counter[str] = Counter()
        self.stop = threading.Event()
        self.news: queue.Queue[tuple[Run, int | Outcome | Exception]] = queue.Queue()

    def run(self) -> None:
        """Until all have ended, or a signal or a full disk says stop."""
        try:
            with StopSignals() as signals:
                while self.under_way or (self.waiting and not self.stop.is_set()):
                    if signals.received and not self.stop.is_set():
                        self.display.line(f"{signals.received}: the runs under way save their state and end")
                        self._stop(signals.received)
                    self._start_some()
                    with suppress(queue.Empty):
                        self._take(*self.news.get(timeout=POLL))
        finally:
            self.stop.set()
            for thread in self.under_way.values():
                thread.join()
            self.engine.close()

    def _start_some(self) -> None:
        while not self.stop.is_set() and self.waiting and len(self.under_way) < self.engine.capacity():
            run = self.waiting.popleft()
            (run.folder / execution.ERROR).unlink(missing_ok=True)
            self.display.started(run)
            self.under_way[run.id] = threading.Thread(target=self._execute, args=(run,), daemon=True)
            self.under_way[run.id].start()

    def _execute(self, run: Run) -> None:
        try:
            self.news.put((run, self.engine.execute(run, self.stop, lambda steps: self.news.put((run, steps)))))
        except Exception as error:  # of the engine, not of the run
            self.news.put((run, error))

    def _take(self, run: Run, news: int | Outcome | Exception) -> None:
        if isinstance(news, int):
            self.display.stepped(run, news)
            return
        del self.under_way[run.id]
        if isinstance(news, Exception):
            if not is_disk_full(news):
                raise news
            news = Outcome(execution.DISK_FULL, str(news))
        self.display.ended(run, news)
        if news.status == execution.DISK_FULL:
            self._stop(execution.DISK_FULL, news.message)
        elif news.status in (execution.LOST, execution.STOPPED) and not self.stop.is_set():
            self.losses[run.id] += 1  # somebody ended the run's process, not the run
            if self.losses[run.id] < MAX_LOSSES:
                self.waiting.appendleft(run)
            else:
                execution.write_error(run.folder, f"given up after {MAX_LOSSES} times: {news.message}")

    def _stop(self, reason: str, message: str = "") -> None:
        if not self.stop.is_set():
            self.summary.stopped_by, self.summary.message = reason, message
            self.stop.set()
