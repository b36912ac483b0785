"""Statistics over seeds and over tasks, after Agarwal et al., "Deep reinforcement learning at the edge of the statistical
precipice" (arXiv 2108.13264). Scores of a task are an array (n_runs,), scores of several tasks a list of such.

Intervals are percentile bootstraps, stratified: every task's runs are resampled by themselves (as ``scipy.stats.bootstrap``
does it for several samples, which however refuses a task with a single run). All are seeded.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

CONFIDENCE = 0.95
N_RESAMPLES = 2000
Scores = Sequence[np.ndarray]  # per task, (n_runs,)
Interval = tuple[float, float]


def interquartile_mean(scores: Scores) -> float:
    """The mean of the middle half of all runs of all tasks."""
    from scipy.stats import trim_mean

    return float(trim_mean(np.concatenate(scores), 0.25))


def interquartile_mean_interval(scores: Scores, seed: int = 0) -> Interval:
    """Bounds of the 95 % interval of :func:`interquartile_mean`; NaN where every task has a single run."""
    from scipy.stats import trim_mean

    return _bootstrap(scores, lambda joined: trim_mean(joined, 0.25, axis=-1), seed)


def performance_profile(scores: Scores, thresholds: np.ndarray) -> np.ndarray:
    """Which share of the runs scores above each of n thresholds, (n,)."""
    return (np.concatenate(scores)[None, :] > thresholds[:, None]).mean(axis=1)


def performance_profile_interval(scores: Scores, thresholds: np.ndarray, seed: int = 0) -> np.ndarray:
    """(2, n) bounds of the 95 % interval at each of n thresholds."""

    def bounds(threshold: float) -> Interval:
        return _bootstrap(scores, lambda joined: (joined > threshold).mean(axis=-1), seed)

    return np.array([bounds(threshold) for threshold in thresholds]).T


def probability_of_improvement(scores: Scores, others: Scores) -> float:
    """How probable it is that a run of one algorithm beats a run of another on a task drawn at random; ties count half: the
    mean over the tasks of the Mann-Whitney statistic, over the number of pairs."""
    return float(np.mean([_wins(one[None], other[None])[0] for one, other in zip(scores, others, strict=True)]))


def probability_of_improvement_interval(scores: Scores, others: Scores, seed: int = 0) -> Interval:
    """Bounds of the 95 % interval of :func:`probability_of_improvement`."""
    ends = np.cumsum([len(part) for part in (*scores, *others)])

    def statistic(joined: np.ndarray) -> np.ndarray:
        parts = np.split(joined, ends[:-1], axis=-1)
        pairs = zip(parts[: len(scores)], parts[len(scores) :], strict=True)
        return np.mean([_wins(one, other) for one, other in pairs], axis=0)

    return _bootstrap([*scores, *others], statistic, seed)


def _wins(scores: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Share of the pairs in which the first is larger: (..., n_runs) and (..., n_others) to (...)."""
    difference = scores[..., :, None] - others[..., None, :]
    return ((difference > 0) + 0.5 * (difference == 0)).mean(axis=(-2, -1))


def _bootstrap(scores: Scores, statistic: Callable[[np.ndarray], np.ndarray], seed: int) -> Interval:
    """The percentile interval of a statistic of all runs laid end to end, (..., n) to (...)."""
    if all(len(part) == 1 for part in scores):
        return math.nan, math.nan
    generator = np.random.default_rng(seed)
    resampled = [part[generator.integers(0, len(part), (N_RESAMPLES, len(part)))] for part in scores]
    values = statistic(np.concatenate(resampled, axis=-1))
    low, high = np.quantile(values, [(1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0])
    return float(low), float(high)


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
