"""How long a comparison will take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from sb3_actpc.checkpoints import list_bundles
from sb3_actpc.experiments.comparison.display import duration
from sb3_actpc.experiments.comparison.execution import FINISHED, run_status
from sb3_actpc.experiments.comparison.run_table import PlannedRun
from sb3_actpc.experiments.comparison.schedule import is_to_do
from sb3_actpc.experiments.runs.record import read_result
from sb3_actpc.experiments.runs.run import CHECKPOINTS

# seconds that 1,000 steps take on one core, until a run of the comparison itself is finished: rounded from the README's
# figures for HalfCheetah (12,000 scheduled steps in three minutes; its speed table for the other two)
GUESS = {"scheduled": 15.0, "iterative": 35.0, "other": 10.0}
MEASURED, KIN, GUESSED = "this comparison", "another task", "a guess"


@dataclass(frozen=True)
class Estimate:
    """
    :param seconds: that what is left of the run will take
    :param source: what the figure comes from
    """

    seconds: float
    source: str


def estimate_runs(runs: Sequence[PlannedRun]) -> dict[str, Estimate]:
    """
    :param runs: the table
    :return: by the run's id; from finished runs of the same variant and task, else of the same variant, else guessed
    """
    speeds = [(run.variant, run.task, _seconds_per_step(run.folder)) for run in runs if run_status(run.folder) == FINISHED]
    estimates = {}
    for run in runs:
        left = max(run.n_timesteps - steps_done(run.folder), 0)
        own = [speed for variant, task, speed in speeds if (variant, task) == (run.variant, run.task)]
        kin = [speed for variant, _, speed in speeds if variant == run.variant]
        if own or kin:
            estimates[run.id] = Estimate(left * median(own or kin), MEASURED if own else KIN)
        else:
            estimates[run.id] = Estimate(left * _guess(run) / 1000.0, GUESSED)
    return estimates


def steps_done(folder: Path) -> int:
    """
    :param folder: run folder
    :return: environment steps until its last checkpoint; 0 without one
    """
    bundles = list_bundles(folder / CHECKPOINTS)
    return int(bundles[-1].name.rpartition("_")[2]) if bundles else 0


def describe_table(runs: Sequence[PlannedRun], n_workers: int, retry_failed: bool) -> str:
    """The table as text, with the time that it will take.

    :param runs: the table
    :param n_workers: runs at a time
    :param retry_failed: whether failed runs are tried again
    :return: lines
    """
    estimates = estimate_runs(runs)
    status = {run.id: run_status(run.folder) for run in runs}
    rows = [["id", "task", "variant", "seed", "steps", "state", "time", "from"]]
    for run in runs:
        one = estimates[run.id]
        time = ["", ""] if status[run.id] == FINISHED else [duration(one.seconds), one.source]
        rows.append([run.id, run.task, run.variant, str(run.config.seed), str(run.n_timesteps), status[run.id], *time])
    to_do = [estimates[run.id].seconds for run in runs if is_to_do(status[run.id], retry_failed)]
    total = makespan(to_do, n_workers)
    guessed = sum(one.source == GUESSED for one in estimates.values())
    note = f" ({guessed} of the times are guesses: a finished run replaces them)" if guessed else ""
    return f"{align(rows)}\n\n{len(to_do)} of {len(runs)} runs to do, {n_workers} at a time: about {duration(total)}{note}"


def makespan(seconds: Sequence[float], n_workers: int) -> float:
    """
    :param seconds: of each run, in the order in which they begin
    :param n_workers: how many run at a time
    :return: seconds until the last has ended
    """
    free = [0.0] * n_workers
    for one in seconds:
        earliest = free.index(min(free))
        free[earliest] += one
    return max(free)


def align(rows: Sequence[Sequence[str]]) -> str:
    """
    :param rows: of texts, each as long as the first
    :return: lines with the columns below each other
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows)


def _seconds_per_step(folder: Path) -> float:
    result = read_result(folder)
    return float(result["wall_seconds"]) / max(int(result["timesteps"]), 1)


def _guess(run: PlannedRun) -> float:
    if run.config.algo != "actpc":
        return GUESS["other"]
    from sb3_actpc.experiments.runs.config import load_preset

    settings: Mapping[str, object] = {
        **load_preset(run.config.preset or run.config.algo, run.config.env),
        **run.config.overrides,
    }
    return GUESS["scheduled" if settings.get("settling") == "scheduled" else "iterative"]
