"""Observations that change by less than float32 can hold."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

# changes of an observation below these, absolute and relative to its size, are numerical noise
SMALLEST_CHANGE, SMALLEST_RELATIVE_CHANGE = 1e-6, 1e-11


def indistinguishable_features(observations: Any, names: Sequence[str] | None = None) -> list[str]:
    """The features that float32, in which agents compute and demonstrations are stored, cannot follow: most of their changes
    from one row to the next become no change at all. Timestamps of 1.7e9 seconds are an example.

    :param observations: (N, ...) rows in the order of time, or a dictionary of such, in the environment's precision
    :param names: of the columns of an array; ``column 3`` by default
    :return: the names of those features; of a dictionary ``clock[0]``
    """
    if isinstance(observations, Mapping):
        found = []
        for key, part in observations.items():
            inner = [f"[{index}]" for index in range(int(np.prod(np.shape(part)[1:])))]
            is_nested = isinstance(part, Mapping)
            found += [f"{key}/{name}" if is_nested else f"{key}{name}" for name in indistinguishable_features(part, inner)]
        return found
    given = np.asarray(observations)
    if len(given) < 2 or np.can_cast(given.dtype, np.float32):
        return []
    rows = given.reshape(len(given), -1).astype(np.float64)
    changes = np.abs(np.diff(rows, axis=0))
    with np.errstate(over="ignore", invalid="ignore"):
        is_lost = np.diff(rows.astype(np.float32), axis=0) == 0.0
    is_change = changes > np.maximum(SMALLEST_CHANGE, SMALLEST_RELATIVE_CHANGE * np.abs(rows[1:]))
    columns = np.flatnonzero((is_change & is_lost).sum(axis=0) > 0.5 * np.maximum(is_change.sum(axis=0), 1))
    return [f"column {index}" if names is None else names[index] for index in columns.tolist()]


def warn_of_indistinguishable(observations: Any, source: str, names: Sequence[str] | None = None) -> None:
    """A UserWarning that names the features of :func:`indistinguishable_features`, if there are any."""
    features = indistinguishable_features(observations, names)
    if features:
        prefix = f"{source}: " if source else ""
        warnings.warn(
            f"{prefix}observations: float32 cannot tell apart successive values of {', '.join(features)}: let the environment "
            "subtract an offset from them, such as the value at the reset",
            stacklevel=3,
        )
