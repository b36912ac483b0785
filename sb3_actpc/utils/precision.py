"""Observations that change by less than float32 can hold."""

import warnings

import numpy as np

# changes of an observation below these, absolute and relative to its size, are numerical noise
SMALLEST_CHANGE, SMALLEST_RELATIVE_CHANGE = 1e-6, 1e-11


def warn_of_indistinguishable(observations: np.ndarray, source: str) -> None:
    """A UserWarning that names the features which float32, in which agents compute and demonstrations are stored, cannot
    follow: most of their changes from one row to the next become no change at all. Timestamps of 1.7e9 seconds are an example.

    :param observations: (N, ...) rows in the order of time, in the environment's precision
    :param source: for the message
    """
    given = np.asarray(observations)
    if len(given) < 2 or np.can_cast(given.dtype, np.float32):
        return
    rows = given.reshape(len(given), -1).astype(np.float64)
    changes = np.abs(np.diff(rows, axis=0))
    with np.errstate(over="ignore", invalid="ignore"):
        is_lost = np.diff(rows.astype(np.float32), axis=0) == 0.0
    is_change = changes > np.maximum(SMALLEST_CHANGE, SMALLEST_RELATIVE_CHANGE * np.abs(rows[1:]))
    columns = np.flatnonzero((is_change & is_lost).sum(axis=0) > 0.5 * np.maximum(is_change.sum(axis=0), 1))
    if len(columns):
        prefix = f"{source}: " if source else ""
        warnings.warn(
            f"{prefix}observations: float32 cannot tell apart successive values of "
            f"{', '.join(f'column {index}' for index in columns)}: let the environment subtract an offset from them, such as "
            "the value at the reset",
            stacklevel=3,
        )
