"""Figures that results are put beside: the paper's own, and the scores of random actions and of the demonstrators.

``python benchmarks/reference_scores.py`` measures the latter two again.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

PAPER_FILE = Path(__file__).with_name("paper_results.csv")
SCORES_FILE = Path(__file__).with_name("reference_scores.csv")
_SUCCESS_TABLE = "tab:robosuite_metrics"  # its scores are rates of success in percent


@dataclass(frozen=True)
class ReferenceScore:
    """Means with which a task's evaluations are normalised."""

    random: float  # of uniformly random actions
    demonstrators: float  # of the demonstrations that ship with the package
    # what is meant, a column of ``progress.csv``: ``"dense_return"``, or ``"success_rate"`` where the paper gives success (an
    # episode that ends with it has the smaller dense return the sooner it succeeds)
    measure: str = "dense_return"

    def normalize(self, values: Any) -> Any:
        """0 for random actions, 1 for the demonstrators; values of any shape."""
        return (values - self.random) / (self.demonstrators - self.random)


def paper_results(env_id: str | None = None) -> pd.DataFrame:
    """Rows of the paper's two tables of results (arXiv 2209.09174; five trials, mean and standard deviation).

    :param env_id: Gymnasium id of a task, any version; None for all
    :return: ``task`` (our name without its version), ``algorithm`` (as the paper writes it), ``algo`` (our name), ``score``
        and ``score_std`` (average return over the last 100 episodes; of robosuite tasks, success in percent),
        ``r_stability`` and ``r_stability_std`` ("S-Dist" of robosuite tasks; NaN where the paper gives none), ``table``
        (label in the paper's source), ``is_success``; no row for a task that the paper does not have
    """
    rows = pd.read_csv(PAPER_FILE)
    rows["is_success"] = rows["table"] == _SUCCESS_TABLE
    return rows if env_id is None else rows[rows["task"] == env_id.rpartition(":")[2].rpartition("-")[0]]


@cache
def reference_score(env_id: str) -> ReferenceScore | None:
    """The scores of a task, with a module or without; None where none were measured."""
    row = pd.read_csv(SCORES_FILE, index_col="env").dropna().T.get(env_id.rpartition(":")[2])
    return None if row is None else ReferenceScore(float(row.random_score), float(row.demonstrators_score), row.measure)


def measure_of(env_id: str) -> str:
    """The column of ``progress.csv`` by which a task is compared: ``"success_rate"`` or ``"dense_return"``."""
    reference = reference_score(env_id)
    return "dense_return" if reference is None else reference.measure
