"""Tables as Markdown, and numbers as their cells."""

import math

import numpy as np
import pandas as pd

from sb3_actpc.experiments.report.statistics import Interval

UNDEFINED = "n/a"


def number(value: float, form: str) -> str:
    """A cell in a format such as ``".1f"``; NaN is an undefined one."""
    text = UNDEFINED if math.isnan(value) else format(value, form)
    return text.removeprefix("-") if not text.strip("-0.") else text  # no negative zero


def mean_and_deviation(values: np.ndarray, form: str) -> str:
    """Mean ± sample standard deviation of those of (n_seeds,) that are defined, and of how many (n of N) where not of all."""
    known = values[~np.isnan(values)]
    if not len(known):
        return UNDEFINED
    spread = f" ± {format(known.std(ddof=1), form)}" if len(known) > 1 else ""
    share = f" ({len(known)} of {len(values)})" if len(known) < len(values) else ""
    return f"{format(known.mean(), form)}{spread}{share}"


def interval(bounds: Interval, form: str) -> str:
    """A cell of lower and upper bound; empty where they are NaN."""
    return "" if math.isnan(bounds[0]) else f"{format(bounds[0], form)} to {format(bounds[1], form)}"


def markdown(table: pd.DataFrame) -> str:
    """A table of texts in GitHub's Markdown; of columns with two levels, each is named ``first: second``."""
    names = [": ".join(filter(None, name)) if isinstance(name, tuple) else str(name) for name in table.columns]
    lines = [names, ["---"] * len(names), *table.astype(str).to_numpy().tolist()]
    return "\n".join("| " + " | ".join(text.replace("|", "\\|") for text in line) + " |" for line in lines)
