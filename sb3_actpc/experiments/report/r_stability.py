"""R-stability: how far an agent's smoothed returns stay from the best that it reached (arXiv 2209.09174, appendix).

    RS = 1/K_e Σ_i |(W^μ_i - max W) / max W|

W are the returns of the last K_e = 100 episodes. W^μ_i is the rolling average of the 100 values before the i-th of them, so
that 200 episodes are needed. 0 is perfect stability.

What follows from the formula, and is not mended here: it divides by the best return, so that it is undefined where that is 0
(an agent that never gets anything), and returns far below 0 give large values (the best of a Reacher is near 0: -8 on average
beside a best of -2 gives 3). A poor agent that is always equally poor gets a good value.
"""

from __future__ import annotations

import math

import numpy as np

WINDOW = 100  # K_e, and the episodes of the rolling average
N_EPISODES = 2 * WINDOW
TOO_SHORT = f"undefined: fewer than {N_EPISODES} episodes"
BEST_IS_ZERO = f"undefined: the best of the last {WINDOW} is 0"


def r_stability(returns: np.ndarray) -> float:
    """
    :param returns: (N,) dense or sparse returns, or successes, of all training episodes in order
    :return: R-stability; NaN where it is undefined, see :func:`undefined_because`
    """
    if undefined_because(returns):
        return math.nan
    last = returns[-N_EPISODES:].astype(np.float64)
    best = last[WINDOW:].max()
    # the i-th of the last 100 episodes is preceded by the values i to i + 99 of the last 200
    sums = np.cumsum(np.concatenate([[0.0], last]))
    smoothed = (sums[WINDOW:-1] - sums[: -WINDOW - 1]) / WINDOW
    return float(np.mean(np.abs((smoothed - best) / best)))


def undefined_because(returns: np.ndarray) -> str:
    """
    :param returns: as in :func:`r_stability`
    :return: why it is undefined; empty where it is defined
    """
    if len(returns) < N_EPISODES:
        return TOO_SHORT
    if np.isnan(returns[-N_EPISODES:]).any():
        return "undefined: not reported by the task"
    return BEST_IS_ZERO if returns[-WINDOW:].max() == 0 else ""


def smooth(values: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """The rolling mean of the paper's figures; the first values are means of as many as there are.

    :param values: (N,)
    :param window: how many values each mean is taken over
    :return: (N,)
    """
    sums = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - window, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)


def final_mean(values: np.ndarray) -> float:
    """
    :param values: (N,) of all training episodes in order
    :return: the mean of the last 100; NaN where there are fewer
    """
    return float(values[-WINDOW:].mean()) if len(values) >= WINDOW else math.nan
