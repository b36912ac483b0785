"""What the runs of a comparison have measured, read from their folders."""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sb3_actpc.experiments.comparison.execution import ERROR, FINISHED, read_error, run_status
from sb3_actpc.experiments.comparison.run_table import content_id
from sb3_actpc.experiments.report.r_stability import final_mean, r_stability
from sb3_actpc.experiments.report.references import reference_score
from sb3_actpc.experiments.runs.episode_log import EPISODES
from sb3_actpc.experiments.runs.evaluation import PROGRESS
from sb3_actpc.experiments.runs.record import CONFIG, read_config
from sb3_actpc.experiments.runs.run import DIAGNOSTICS

Columns = dict[str, np.ndarray]


def read_columns(path: Path) -> Columns:
    """
    :param path: a CSV file of numbers; a last row that was not written to its end is left out
    :return: each column, (n_rows,) float64, NaN where it is empty; empty arrays, or none, where there is no row or no file
    """
    if not path.is_file():
        return {}
    with open(path, newline="", encoding="utf-8") as file:
        header, *rows = [*csv.reader(file)] or [[]]
    values = [[_number(text) for text in row] for row in rows if len(row) == len(header)]
    table = np.array(values, dtype=np.float64).reshape(len(values), len(header))
    return {name: table[:, index] for index, name in enumerate(header)}


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


@dataclass(frozen=True)
class RunResult:
    """A run on the disk.

    :param folder: its own
    :param task: the comparison's task
    :param variant: name of the variant
    :param status: of :func:`~sb3_actpc.experiments.comparison.execution.run_status`
    :param config: its ``config.json``; empty where it failed before that was written
    :param error: what ended a failed one
    """

    folder: Path
    task: str
    variant: str
    status: str
    config: dict[str, Any] = field(default_factory=dict)
    error: str = ""

    @cached_property
    def progress(self) -> Columns:
        """The evaluations."""
        return read_columns(self.folder / PROGRESS)

    @cached_property
    def episodes(self) -> Columns:
        """Every training episode."""
        return read_columns(self.folder / EPISODES)

    @cached_property
    def diagnostics(self) -> Columns:
        """What the agent logged about itself."""
        return read_columns(self.folder / DIAGNOSTICS)

    @property
    def seed(self) -> int:
        """Of the run."""
        return int(self.folder.name.partition("_")[0].removeprefix("seed"))

    @property
    def content(self) -> str:
        """An id that the runs of all seeds share which differ in nothing else."""
        return content_id(self.config)

    @property
    def timesteps(self) -> int:
        """Environment steps until the last evaluation."""
        steps = self.progress.get("timesteps", np.empty(0))
        return int(steps[-1]) if len(steps) else 0

    def last(self, name: str) -> float:
        """
        :param name: column of ``progress.csv``
        :return: its last value; NaN without one
        """
        values = self.progress.get(name, np.empty(0))
        return float(values[-1]) if len(values) else math.nan

    def episode_values(self, name: str) -> np.ndarray:
        """
        :param name: column of ``episodes.csv``
        :return: (n_episodes,)
        """
        return self.episodes.get(name, np.empty(0))

    @cached_property
    def measures(self) -> dict[str, float]:
        """Everything that the report gives of a single run; NaN where it is undefined."""
        values = {f"average_{name}": final_mean(self.episode_values(column)) for name, column in _EPISODE_MEASURES.items()}
        values |= {
            f"r_stability_{name}": r_stability(self.episode_values(column)) for name, column in _EPISODE_MEASURES.items()
        }
        values |= {f"evaluation_{name}": self.last(column) for name, column in _EVALUATION_MEASURES.items()}
        reference = reference_score(self.task)
        values["normalized"] = math.nan if reference is None else reference.normalize(self.last(reference.measure))
        demonstrators = self.config.get("demonstrators_return")
        values["demonstrators_return"] = math.nan if demonstrators is None else float(demonstrators)
        training_seconds = self.last("seconds") - self.last("evaluation_seconds")
        values["steps_per_second"] = self.timesteps / max(training_seconds, 0.01)
        values["seconds"], values["updates"] = self.last("seconds"), self.last("updates")
        return values


_EPISODE_MEASURES = {"dense": "dense_return", "sparse": "sparse_return", "success": "success"}
_EVALUATION_MEASURES = {"dense": "dense_return", "sparse": "sparse_return", "success": "success_rate"}


@dataclass(frozen=True)
class Group:
    """The finished runs of one variant on one task, which differ in their seeds alone.

    :param task: Gymnasium id
    :param variant: name, with a part of an id where several sets of settings go by that name
    :param runs: by seed
    """

    task: str
    variant: str
    runs: tuple[RunResult, ...]

    @property
    def algo(self) -> str:
        """Name of the algorithm."""
        return str(self.runs[0].config["algo"])

    def values(self, name: str) -> np.ndarray:
        """
        :param name: key of :attr:`RunResult.measures`
        :return: (n_seeds,)
        """
        return np.array([run.measures[name] for run in self.runs])

    def last(self, name: str) -> np.ndarray:
        """
        :param name: column of ``progress.csv``
        :return: (n_seeds,), the last evaluation of each; NaN without one
        """
        return np.array([run.last(name) for run in self.runs])

    def column(self, get: Callable[[RunResult], np.ndarray]) -> np.ndarray:
        """
        :param get: a column of a run
        :return: (n_seeds, n), cut to the shortest
        """
        columns = [get(run) for run in self.runs]
        return np.stack([column[: min(map(len, columns))] for column in columns])


def load_runs(folder: Path) -> list[RunResult]:
    """
    :param folder: of a comparison
    :return: its runs, begun and finished
    :raises FileNotFoundError: when there is none
    """
    found = sorted({path.parent for name in (CONFIG, ERROR) for path in folder.glob(f"*/*/seed[0-9]*_*/{name}")})
    if not found:
        raise FileNotFoundError(f"no runs in {folder}: make some with sb3-actpc compare --out {folder}")
    return [_load_run(path) for path in found]


def _load_run(folder: Path) -> RunResult:
    variant, task = folder.parent.name, folder.parent.parent.name
    try:
        config = read_config(folder)
    except (FileNotFoundError, ValueError) as error:
        return RunResult(folder, task, variant, run_status(folder), error=read_error(folder) or str(error))
    return RunResult(folder, task, variant, run_status(folder), config, read_error(folder))


def group_runs(runs: Sequence[RunResult]) -> list[Group]:
    """
    :param runs: any
    :return: the finished ones, those together that differ in their seeds alone
    """
    by_content: dict[tuple[str, str, str], list[RunResult]] = defaultdict(list)
    for run in runs:
        if run.status == FINISHED:
            by_content[run.task, run.variant, run.content].append(run)
    names = [(task, variant) for task, variant, _ in by_content]
    groups = []
    for (task, variant, content), members in by_content.items():
        label = variant if names.count((task, variant)) == 1 else f"{variant} [{content[:4]}]"
        groups.append(Group(task, label, tuple(sorted(members, key=lambda run: run.seed))))
    return groups
