"""Statistics over tasks against hand-worked values and scipy's bootstrap."""

import math

import numpy as np
import pytest
from scipy import stats

from sb3_actpc.experiments.report import statistics

SCORES = [np.array([0.1, 0.9, 0.5, 0.3]), np.array([0.7, 0.2, 1.1, 0.6])]


def test_estimates_worked_by_hand() -> None:
    """Sorted: 0.1 0.2 | 0.3 0.5 0.6 0.7 | 0.9 1.1. [1, 2] against [0, 2]: wins 1>0, 2>0, tie 2=2, loss 1<2: 2.5 of 4; [5]
    against [1, 2]: 2 of 2."""
    assert statistics.interquartile_mean(SCORES)[0] == pytest.approx((0.3 + 0.5 + 0.6 + 0.7) / 4)
    shares, *_ = statistics.performance_profile(SCORES, np.array([0.0, 0.5, 2.0]))
    assert shares.tolist() == [1.0, 4 / 8, 0.0]
    value, *_ = statistics.probability_of_improvement(
        [np.array([1.0, 2.0]), np.array([5.0])], [np.array([0.0, 2.0]), np.array([1.0, 2.0])]
    )
    assert value == pytest.approx((2.5 / 4 + 1.0) / 2)


def test_the_interval_is_that_of_scipys_bootstrap_of_several_samples() -> None:
    generator = np.random.default_rng(2)
    scores = [generator.normal(0.4, 0.3, 15), generator.normal(0.7, 0.1, 15)]

    def statistic(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
        return stats.trim_mean(np.concatenate(samples, axis=axis), 0.25, axis=axis)

    theirs = stats.bootstrap(
        scores, statistic, method="percentile", n_resamples=20_000, axis=-1, random_state=np.random.default_rng(1)
    ).confidence_interval
    assert statistics.interquartile_mean(scores)[1:] == pytest.approx((theirs.low, theirs.high), abs=0.01)


def test_intervals_are_stratified_and_seeded() -> None:
    """Tasks whose runs are all alike leave nothing to resample, however different the tasks."""
    assert statistics.interquartile_mean([np.full(4, 0.0), np.full(4, 1.0)])[1:] == (0.5, 0.5)
    assert statistics.interquartile_mean(SCORES) == statistics.interquartile_mean(SCORES)
    assert statistics.interquartile_mean(SCORES) != statistics.interquartile_mean(SCORES, seed=1)


def test_single_runs_have_no_interval() -> None:
    alone = [np.array([0.3])]
    assert math.isnan(statistics.interquartile_mean(alone)[1])
    assert math.isnan(statistics.probability_of_improvement(alone, alone)[1])
    assert np.isnan(statistics.mean_interval(np.ones((1, 3)))[1]).all()


def test_the_interval_over_seeds_is_students() -> None:
    """Two seeds, 0 and 2: mean 1, standard error 1, t(0.975, 1) = 12.706."""
    mean, low, high = statistics.mean_interval(np.array([[0.0], [2.0]]))
    assert (mean[0], low[0], high[0]) == pytest.approx((1.0, 1.0 - 12.706, 1.0 + 12.706), abs=1e-3)


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        (np.full(350, -4.0), 0.0),  # always the same
        (np.tile([0.0, 10.0], 100), 0.5),  # every window has the mean 5, the best is 10: |(5 - 10) / 10|
        (np.r_[np.full(77, 1e6), np.tile([0.0, 10.0], 100)], 0.5),  # only the last 200 count
        (np.tile([-8.0, -2.0], 100), 1.5),  # every mean is -5, the best is -2
        # before the i-th of the last (i = 0 ... 99) lie i ones: the mean of 1 - i / 100
        (np.r_[np.zeros(100), np.ones(100)], 1.0 - 99 / 200),
        (np.zeros(300), math.nan),  # the formula divides by the best
        (np.ones(199), math.nan),
        (np.full(200, math.nan), math.nan),
    ],
)
def test_r_stability_follows_the_papers_formula(returns: np.ndarray, expected: float) -> None:
    assert statistics.r_stability(returns) == pytest.approx(expected, nan_ok=True)
