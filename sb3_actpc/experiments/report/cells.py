"""Numbers as the cells of tables."""

from __future__ import annotations

import math

import numpy as np

from sb3_actpc.experiments.report.statistics import Interval

UNDEFINED = "undefined"


def number(value: float, form: str) -> str:
    """
    :param value: any, NaN for an undefined one
    :param form: of a format, such as ``".1f"``
    :return: a cell
    """
    return UNDEFINED if math.isnan(value) else format(value, form)


def mean_and_deviation(values: np.ndarray, form: str) -> str:
    """
    :param values: (n_seeds,), NaN where undefined
    :param form: of a format
    :return: mean ± sample standard deviation of those that are defined, and of how many where not of all
    """
    known = values[~np.isnan(values)]
    if not len(known):
        return UNDEFINED
    spread = f" ± {format(known.std(ddof=1), form)}" if len(known) > 1 else ""
    share = f" ({len(known)} of {len(values)} seeds)" if len(known) < len(values) else ""
    return f"{format(known.mean(), form)}{spread}{share}"


def interval(bounds: Interval, form: str) -> str:
    """
    :param bounds: lower and upper, NaN where there is none
    :param form: of a format
    :return: a cell
    """
    return "" if math.isnan(bounds[0]) else f"{format(bounds[0], form)} to {format(bounds[1], form)}"
