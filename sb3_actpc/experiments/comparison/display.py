"""How a comparison goes on, live in a terminal, line by line elsewhere; and what it consists of."""

from collections.abc import Sequence

import pandas as pd
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sb3_actpc.experiments.comparison.execution import DISK_FULL, FINISHED, LOST, STOPPED, Outcome, run_status
from sb3_actpc.experiments.runs import Run
from sb3_actpc.experiments.runs.record import read_result

_WORDS = {LOST: "lost, will go on", STOPPED: "stopped, will go on", DISK_FULL: "stopped by a full disk"}


class Display:
    """A line for every run that begins or ends; in a terminal, and with ``bars``, also bars of the runs under way and of the
    steps of all. ``console`` is rich's."""

    def __init__(self, bars: bool = True, console: Console | None = None) -> None:
        self.console = console or Console()
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        times = (TimeElapsedColumn(), TimeRemainingColumn())
        self.progress = Progress(*columns, *times, console=self.console, disable=not (bars and self.console.is_terminal))
        self.n_runs, self.n_finished = 0, 0
        self._bars: dict[str, TaskID] = {}
        self._steps: dict[str, int] = {}  # done by this command or before

    def __enter__(self) -> "Display":
        self.progress.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.progress.stop()

    def begin(self, runs: Sequence[Run], n_finished: int) -> None:
        """Runs that are still to do, and how many were done before."""
        self.n_runs, self.n_finished = len(runs) + n_finished, n_finished
        self.line(f"{n_finished} runs are done, {len(runs)} to do")
        self._bars[""] = self.progress.add_task("all steps", total=sum(run.n_timesteps or 0 for run in runs))

    def started(self, run: Run) -> None:
        """It is now under way."""
        if self.progress.disable:
            self.line(f"started   {run.label}")
        self._bars[run.id] = self.progress.add_task(run.label, total=run.n_timesteps)

    def stepped(self, run: Run, steps: int) -> None:
        """It has done so many steps."""
        self._steps[run.id] = steps
        self.progress.update(self._bars[run.id], completed=steps)
        self.progress.update(self._bars[""], completed=sum(self._steps.values()))

    def ended(self, run: Run, outcome: Outcome) -> None:
        """It is no longer under way."""
        if outcome.status == FINISHED:
            self.stepped(run, run.n_timesteps or 0)
        self.n_finished += outcome.status == FINISHED
        message = f": {outcome.message}" if outcome.message else ""
        word = _WORDS.get(outcome.status, outcome.status)
        self.line(f"{word:9s} {run.label}{message}  ({self.n_finished} of {self.n_runs} runs done)")
        self.progress.remove_task(self._bars.pop(run.id))

    def line(self, text: str) -> None:
        """Show a line, above the bars."""
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)


def describe_runs(runs: Sequence[Run]) -> str:
    """The runs as a table, with the seconds that they took; those not finished with what finished runs of the same task,
    variant and steps took (the median), where there are any."""
    rows = [[run.id, run.task, run.name, run.seed, run.n_timesteps, run_status(run.folder)] for run in runs]
    table = pd.DataFrame(rows, columns=["id", "task", "variant", "seed", "steps", "state"])
    is_done = table["state"] == FINISHED
    done = [run for run, finished in zip(runs, is_done, strict=True) if finished]
    table.loc[is_done, "seconds"] = [float(read_result(run.folder)["wall_seconds"]) for run in done]
    alike = table.groupby(["task", "variant", "steps"])["seconds"].transform("median")
    table["seconds"] = table["seconds"].fillna(alike).map("{:.0f}".format).replace("nan", "")
    return f"{table.to_string(index=False)}\n\n{len(runs) - len(done)} of {len(runs)} runs to do"
