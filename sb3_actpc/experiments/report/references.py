"""Scores of random actions and of the shipped demonstrations, by which results are normalized across tasks.

``python benchmarks/reference_scores.py`` measures them again.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

SCORES_FILE = Path(__file__).with_name("reference_scores.csv")


@dataclass(frozen=True)
class ReferenceScore:
    """Mean scores of a task, in units of ``measure``."""

    random: float  # of uniformly random actions
    demonstrators: float  # of the demonstrations that ship with the package
    measure: str = "dense_return"  # a column of ``progress.csv``: ``"dense_return"`` or ``"success"``

    def normalize(self, values: Any) -> Any:
        """Map random actions to 0 and the demonstrators to 1; values of any shape."""
        return (values - self.random) / (self.demonstrators - self.random)


@cache
def reference_score(env_id: str) -> ReferenceScore | None:
    """The scores of a task, with or without a module in its id; None where none were measured."""
    row = pd.read_csv(SCORES_FILE, index_col="env").dropna().T.get(env_id.rpartition(":")[2])
    return None if row is None else ReferenceScore(float(row.random_score), float(row.demonstrators_score), row.measure)
