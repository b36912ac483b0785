"""How a comparison goes on, live in a terminal, line by line elsewhere; and what it consists of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median
from types import TracebackType

import pandas as pd
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sb3_actpc.experiments.comparison.execution import DISK_FULL, FINISHED, LOST, STOPPED, Outcome, run_status
from sb3_actpc.experiments.runs import Run
from sb3_actpc.experiments.runs.record import read_result

_WORDS = {
    LOST: "lost, will go on",
    STOPPED: "stopped, will go on",
    DISK_FULL: "stopped by a full disk",
}


class LineDisplay:
    """A line for every run that begins or ends.

    :param write: given each line
    """

    def __init__(self, write: Callable[[str], None]) -> None:
        self.write = write
        self.n_runs, self.n_finished = 0, 0

    def __enter__(self) -> LineDisplay:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Nothing is to be put away."""

    def begin(self, runs: Sequence[Run], n_finished: int) -> None:
        """:param runs: those still to do
        :param n_finished: those done before"""
        self.n_runs, self.n_finished = len(runs) + n_finished, n_finished
        self.line(f"{n_finished} runs are done, {len(runs)} to do")

    def started(self, run: Run) -> None:
        """:param run: now under way"""
        self.line(f"started   {run.label}")

    def stepped(self, run: Run, steps: int) -> None:
        """:param run: under way
        :param steps: so far"""

    def ended(self, run: Run, outcome: Outcome) -> None:
        """:param run: no longer under way
        :param outcome: what came of it"""
        self.n_finished += outcome.status == FINISHED
        message = f": {outcome.message}" if outcome.message else ""
        word = _WORDS.get(outcome.status, outcome.status)
        self.line(f"{word:9s} {run.label}{message}  ({self.n_finished} of {self.n_runs} runs done)")

    def line(self, text: str) -> None:
        """:param text: one line"""
        self.write(text)


class LiveDisplay(LineDisplay):
    """Bars of the runs under way, and one for the steps of all.

    :param console: of rich
    """

    def __init__(self, console: Console) -> None:
        super().__init__(lambda text: console.print(text, markup=False, highlight=False))
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self.progress = Progress(*columns, console=console)
        self._bars: dict[str, TaskID] = {}
        self._steps: dict[str, int] = {}  # done by this command or before

    def __enter__(self) -> LiveDisplay:
        self.progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Leave the terminal as it was."""
        self.progress.stop()

    def begin(self, runs: Sequence[Run], n_finished: int) -> None:
        """:param runs: those still to do
        :param n_finished: those done before"""
        super().begin(runs, n_finished)
        self._bars[""] = self.progress.add_task("all steps", total=sum(run.n_timesteps or 0 for run in runs))

    def started(self, run: Run) -> None:
        """:param run: now under way"""
        self._bars[run.id] = self.progress.add_task(run.label, total=run.n_timesteps)

    def stepped(self, run: Run, steps: int) -> None:
        """:param run: under way
        :param steps: so far"""
        self._steps[run.id] = steps
        self.progress.update(self._bars[run.id], completed=steps)
        self.progress.update(self._bars[""], completed=sum(self._steps.values()))

    def ended(self, run: Run, outcome: Outcome) -> None:
        """:param run: no longer under way
        :param outcome: what came of it"""
        if outcome.status == FINISHED:
            self.stepped(run, run.n_timesteps or 0)
        super().ended(run, outcome)
        self.progress.remove_task(self._bars.pop(run.id))


def make_display(live: bool) -> LineDisplay:
    """
    :param live: bars, where the output is a terminal
    :return: context manager
    """
    console = Console()
    if live and console.is_terminal:
        return LiveDisplay(console)
    return LineDisplay(lambda text: print(text, flush=True))


def describe_runs(runs: Sequence[Run]) -> str:
    """The runs as a table, with the seconds that they took; those not finished with what finished runs of the same task,
    variant and steps took (the median), where there are any.

    :param runs: of a comparison
    :return: lines
    """
    status = {run.id: run_status(run.folder) for run in runs}
    taken = {run.id: float(read_result(run.folder)["wall_seconds"]) for run in runs if status[run.id] == FINISHED}

    def seconds(run: Run) -> str:
        alike = [taken[other.id] for other in runs if other.id in taken and _kind(other) == _kind(run)]
        known = taken.get(run.id, median(alike) if alike else None)
        return "" if known is None else f"{known:.0f}"

    rows = [[run.id, run.task, run.name, run.seed, run.n_timesteps, status[run.id], seconds(run)] for run in runs]
    table = pd.DataFrame(rows, columns=["id", "task", "variant", "seed", "steps", "state", "seconds"])
    return f"{table.to_string(index=False)}\n\n{len(runs) - len(taken)} of {len(runs)} runs to do"


def _kind(run: Run) -> tuple[str | None, str | None, int | None]:
    return run.task, run.name, run.n_timesteps
