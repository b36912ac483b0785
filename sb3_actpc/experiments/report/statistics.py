"""Statistics over seeds and over tasks, after Agarwal et al., "Deep reinforcement learning at the edge of the statistical
precipice" (arXiv 2108.13264). Scores of a task are an array (n_runs,), scores of several tasks a list of such.

Each comes with the bounds of its 95 % interval, NaN where every task has a single run. Intervals are percentile bootstraps,
stratified: every task's runs are resampled by themselves (as ``scipy.stats.bootstrap`` does it for several samples, which
however refuses a task with a single run). All are seeded.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

CONFIDENCE = 0.95
N_RESAMPLES = 2000
Scores = Sequence[np.ndarray]  # per task, (n_runs,)
Estimate = tuple[float, float, float]  # a value, its lower and its upper bound


def interquartile_mean(scores: Scores, seed: int = 0) -> Estimate:
    """The mean of the middle half of all runs of all tasks."""
    from scipy.stats import trim_mean

    return _estimate(scores, lambda joined: trim_mean(joined, 0.25, axis=-1), seed)


def performance_profile(scores: Scores, thresholds: np.ndarray, seed: int = 0) -> np.ndarray:
    """Which share of the runs scores above each of n thresholds, (3, n)."""

    def share(threshold: float) -> Estimate:
        return _estimate(scores, lambda joined: (joined > threshold).mean(axis=-1), seed)

    return np.array([share(threshold) for threshold in thresholds]).T


def probability_of_improvement(scores: Scores, others: Scores, seed: int = 0) -> Estimate:
    """How probable it is that a run of one algorithm beats a run of another on a task drawn at random; ties count half: the
    mean over the tasks of the Mann-Whitney statistic, over the number of pairs."""
    ends = np.cumsum([len(part) for part in (*scores, *others)])

    def statistic(joined: np.ndarray) -> np.ndarray:
        parts = np.split(joined, ends[:-1], axis=-1)
        pairs = zip(parts[: len(scores)], parts[len(scores) :], strict=True)
        return np.mean([_wins(one, other) for one, other in pairs], axis=0)

    return _estimate([*scores, *others], statistic, seed)


def _wins(scores: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Share of the pairs in which the first is larger: (..., n_runs) and (..., n_others) to (...)."""
    difference = scores[..., :, None] - others[..., None, :]
    return ((difference > 0) + 0.5 * (difference == 0)).mean(axis=(-2, -1))


def _estimate(scores: Scores, statistic: Callable[[np.ndarray], np.ndarray], seed: int) -> Estimate:
    """A statistic of all runs laid end to end, (..., n) to (...), with its interval."""
    value = float(statistic(np.concatenate(scores)))
    if all(len(part) == 1 for part in scores):
        return value, math.nan, math.nan
    generator = np.random.default_rng(seed)
    resampled = [part[generator.integers(0, len(part), (N_RESAMPLES, len(part)))] for part in scores]
    values = statistic(np.concatenate(resampled, axis=-1))
    low, high = np.quantile(values, [(1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0])
    return value, float(low), float(high)


def mean_interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, lower and upper bound, (...) each, over (n_seeds, ...), of a 95 % interval of Student's t distribution, which
    does not flatter a handful of seeds; bounds are NaN for one seed."""
    from scipy.stats import t

    mean = values.mean(axis=0)
    n = len(values)
    if n < 2:
        return mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    half = t.ppf((1.0 + CONFIDENCE) / 2.0, n - 1) * values.std(axis=0, ddof=1) / math.sqrt(n)
    return mean, mean - half, mean + half


def r_stability(returns: np.ndarray, window: int = 100) -> float:
    """R-stability of the returns (or successes) of all training episodes in order, (N,): how far the smoothed ones stay from
    the best, 1/K Σ_i |(W^μ_i - max W) / max W| (arXiv 2209.09174, appendix). W are the last K = ``window``, W^μ_i the mean of
    the K before the i-th. 0 is perfect; NaN with fewer than 2 K episodes, where one is NaN, and where the best is 0."""
    last = np.asarray(returns[-2 * window :], dtype=np.float64)
    best = last[window:].max() if len(last) == 2 * window else 0.0
    if best == 0.0:
        return math.nan
    smoothed = np.lib.stride_tricks.sliding_window_view(last, window)[:-1].mean(axis=1)
    return float(np.mean(np.abs((smoothed - best) / best)))
