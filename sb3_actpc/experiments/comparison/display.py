"""How a comparison goes on, live in a terminal, line by line elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any

from sb3_actpc.experiments.comparison.execution import DISK_FULL, FINISHED, LOST, STOPPED, Outcome
from sb3_actpc.experiments.comparison.run_table import PlannedRun

_WORDS = {
    FINISHED: "finished",
    LOST: "lost, will go on",
    STOPPED: "stopped, will go on",
    DISK_FULL: "stopped by a full disk",
}


class Tally:
    """Steps done, steps per second and time left over all runs of a command."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self.n_steps: dict[str, int] = {}  # of each run still to do
        self.done: dict[str, int] = {}
        self.first: dict[str, int] = {}  # where this command found it
        self.n_runs, self.n_finished, self.n_failed, self.n_running = 0, 0, 0, 0
        self.started = clock()

    def begin(self, runs: Sequence[PlannedRun], n_finished: int) -> None:
        """:param runs: those still to do
        :param n_finished: those done before"""
        self.n_steps = {run.id: run.n_timesteps for run in runs}
        self.n_runs, self.n_finished = len(runs) + n_finished, n_finished
        self.started = self.clock()

    def step(self, run_id: str, steps: int) -> None:
        """:param run_id: which
        :param steps: done so far"""
        self.first.setdefault(run_id, steps)
        self.done[run_id] = steps

    def end(self, run_id: str, status: str) -> None:
        """:param run_id: which
        :param status: of its outcome"""
        self.n_running -= 1
        if status == FINISHED:
            self.n_finished += 1
            self.first.setdefault(run_id, 0)
            self.done[run_id] = self.n_steps[run_id]
        elif status not in (LOST, STOPPED, DISK_FULL):
            self.n_failed += 1
            self.done[run_id] = self.n_steps[run_id] = self.first.get(run_id, 0)  # nothing more to come

    @property
    def steps_per_second(self) -> float:
        """Of all runs together, since the command began."""
        gained = sum(self.done[run_id] - self.first[run_id] for run_id in self.first if run_id in self.done)
        return gained / max(self.clock() - self.started, 1e-9)

    @property
    def seconds_left(self) -> float | None:
        """At the present speed; None before there is one."""
        left = sum(steps - self.done.get(run_id, 0) for run_id, steps in self.n_steps.items())
        speed = self.steps_per_second
        return left / speed if speed > 0 else None

    def summary(self) -> str:
        """One line."""
        left = self.seconds_left
        parts = [
            f"{self.n_finished} of {self.n_runs} runs done",
            f"{self.n_running} running",
            *([f"{self.n_failed} failed"] if self.n_failed else []),
            f"{self.steps_per_second:.0f} steps/s",
            f"{'unknown' if left is None else duration(left)} left",
        ]
        return ", ".join(parts)


def duration(seconds: float) -> str:
    """
    :param seconds: at least 0
    :return: such as ``"2 h 05 min"``
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


class LineDisplay:
    """A line for every run that begins or ends.

    :param write: given each line
    """

    def __init__(self, write: Callable[[str], None]) -> None:
        self.write, self.tally = write, Tally()

    def __enter__(self) -> LineDisplay:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Nothing is to be put away."""

    def begin(self, runs: Sequence[PlannedRun], n_finished: int) -> None:
        """See :class:`~sb3_actpc.experiments.comparison.schedule.Display`, as for the others."""
        self.tally.begin(runs, n_finished)
        self.line(f"{n_finished} runs are done, {len(runs)} to do")

    def started(self, run: PlannedRun) -> None:
        """:param run: now under way"""
        self.tally.n_running += 1
        self.line(f"started   {run.name}")

    def stepped(self, run: PlannedRun, steps: int) -> None:
        """:param run: under way
        :param steps: so far"""
        self.tally.step(run.id, steps)

    def ended(self, run: PlannedRun, outcome: Outcome) -> None:
        """:param run: no longer under way
        :param outcome: what came of it"""
        self.tally.end(run.id, outcome.status)
        message = f": {outcome.message}" if outcome.message else ""
        self.line(f"{_WORDS.get(outcome.status, outcome.status):9s} {run.name}{message}  ({self.tally.summary()})")

    def line(self, text: str) -> None:
        """:param text: one line"""
        self.write(text)


class LiveDisplay(LineDisplay):
    """Bars of the runs under way, and one for all.

    :param console: of rich
    """

    def __init__(self, console: Any) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

        super().__init__(console.print)
        self.progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            console=console,
        )
        self._bars: dict[str, Any] = {}

    def __enter__(self) -> LiveDisplay:
        self.progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Leave the terminal as it was."""
        self.progress.stop()

    def begin(self, runs: Sequence[PlannedRun], n_finished: int) -> None:
        """:param runs: those still to do
        :param n_finished: those done before"""
        super().begin(runs, n_finished)
        self._bars[""] = self.progress.add_task("all runs", total=self.tally.n_runs, completed=n_finished, note="")

    def started(self, run: PlannedRun) -> None:
        """:param run: now under way"""
        self.tally.n_running += 1
        self._bars[run.id] = self.progress.add_task(run.name, total=run.n_timesteps, note="steps")

    def stepped(self, run: PlannedRun, steps: int) -> None:
        """:param run: under way
        :param steps: so far"""
        super().stepped(run, steps)
        self.progress.update(self._bars[run.id], completed=steps)
        self._refresh()

    def ended(self, run: PlannedRun, outcome: Outcome) -> None:
        """:param run: no longer under way
        :param outcome: what came of it"""
        super().ended(run, outcome)
        self.progress.remove_task(self._bars.pop(run.id))
        self._refresh()

    def _refresh(self) -> None:
        self.progress.update(self._bars[""], completed=self.tally.n_finished, note=self.tally.summary())


def make_display(live: bool) -> LineDisplay:
    """
    :param live: bars, where the output is a terminal
    :return: context manager
    """
    from rich.console import Console

    console = Console()
    if live and console.is_terminal:
        return LiveDisplay(console)
    return LineDisplay(lambda text: print(text, flush=True))
