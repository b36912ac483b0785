"""R-stability: how far an agent's smoothed returns stay from the best that it reached (arXiv 2209.09174, appendix).

    RS = 1/K_e Σ_i |(W^μ_i - max W) / max W|

W are the returns of the last K_e = 100 episodes. W^μ_i is the rolling average of the 100 values before the i-th of them, so
that 200 episodes are needed. 0 is perfect stability.

What follows from the formula, and is kept here: it divides by the best return, so that it is undefined where that is 0
(an agent that never gets anything), and returns far below 0 give large values (the best of a Reacher is near 0: -8 on average
beside a best of -2 gives 3). A poor agent that is always equally poor gets a good value.
"""

import math

import numpy as np
import pandas as pd

WINDOW = 100  # K_e, and the episodes of the rolling average
N_EPISODES = 2 * WINDOW


def r_stability(returns: np.ndarray) -> float:
    """R-stability of the dense or sparse returns, or successes, of all training episodes in order, (N,); NaN with fewer than
    200 episodes, where one of the last 200 is NaN, and where the best of the last 100 is 0."""
    last = np.asarray(returns[-N_EPISODES:], dtype=np.float64)
    if len(last) < N_EPISODES or last[WINDOW:].max() == 0:
        return math.nan
    best = last[WINDOW:].max()
    smoothed = np.lib.stride_tricks.sliding_window_view(last, WINDOW)[:-1].mean(axis=1)
    return float(np.mean(np.abs((smoothed - best) / best)))


def smooth(values: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """The rolling mean of the paper's figures, of (N,) or (N, n_seeds) seed by seed; the first values are means of as many
    as there are."""
    return pd.DataFrame(values).rolling(window, min_periods=1).mean().to_numpy().reshape(np.shape(values))


def final_mean(values: np.ndarray) -> float:
    """The mean of the last 100 of (N,) training episodes; NaN where there are fewer."""
    return float(np.mean(values[-WINDOW:])) if len(values) >= WINDOW else math.nan
