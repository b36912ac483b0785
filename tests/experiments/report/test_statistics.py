"""Statistics over tasks against hand-worked values, scipy's bootstrap and, where it can be imported, rliable."""

import math

import numpy as np
import pytest
from scipy import stats

from sb3_actpc.experiments.report import statistics
from sb3_actpc.experiments.report.references import ReferenceScore, reference_score

SCORES = [np.array([0.1, 0.9, 0.5, 0.3]), np.array([0.7, 0.2, 1.1, 0.6])]
OTHERS = [np.array([0.2, 0.4, 0.5, 0.1]), np.array([0.9, 0.3, 0.8, 0.7])]


def test_the_interquartile_mean_leaves_out_a_quarter_at_either_end() -> None:
    """Sorted: 0.1 0.2 | 0.3 0.5 0.6 0.7 | 0.9 1.1."""
    assert statistics.interquartile_mean(SCORES)[0] == pytest.approx((0.3 + 0.5 + 0.6 + 0.7) / 4)


def test_the_profile_is_the_share_of_runs_above_each_threshold() -> None:
    shares, *_ = statistics.performance_profile(SCORES, np.array([0.0, 0.5, 2.0]))
    assert shares.tolist() == [1.0, 4 / 8, 0.0]


def test_probability_of_improvement_counts_pairs_within_a_task_and_ties_by_half() -> None:
    """[1, 2] against [0, 2]: wins 1>0, 2>0, tie 2=2, loss 1<2: 2.5 of 4. [5] against [1, 2]: 2 of 2. Mean of both."""
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


def test_the_resampling_keeps_to_each_task() -> None:
    """Tasks whose runs are all alike leave nothing to resample, however different the tasks."""
    _, low, high = statistics.interquartile_mean([np.full(4, 0.0), np.full(4, 1.0)])
    assert low == high == 0.5


def test_intervals_are_the_same_every_time_and_follow_the_seed() -> None:
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


def test_against_rliable() -> None:
    pytest.importorskip("rliable.metrics", exc_type=Exception)
    from rliable import library, metrics

    joined, others = np.stack(SCORES, axis=1), np.stack(OTHERS, axis=1)  # (n_runs, n_tasks)
    assert statistics.interquartile_mean(SCORES)[0] == pytest.approx(metrics.aggregate_iqm(joined))
    assert statistics.probability_of_improvement(SCORES, OTHERS)[0] == pytest.approx(
        metrics.probability_of_improvement(joined, others)
    )
    thresholds = np.linspace(-0.1, 1.2, 14)
    theirs = [library.run_score_deviation(joined, threshold) for threshold in thresholds]
    assert statistics.performance_profile(SCORES, thresholds)[0] == pytest.approx(theirs)
    many = np.random.default_rng(3).normal(0.5, 0.2, (12, 3))
    _, bounds = library.get_interval_estimates(
        {"a": many}, lambda scores: np.array([metrics.aggregate_iqm(scores)]), reps=4000, random_state=np.random.RandomState(0)
    )
    assert statistics.interquartile_mean(list(many.T))[1:] == pytest.approx(bounds["a"].ravel(), abs=0.015)


def test_random_actions_score_nothing_and_the_demonstrators_one() -> None:
    score = ReferenceScore(random=-10.0, demonstrators=30.0)
    assert score.normalize(np.array([-10.0, 30.0, 10.0])).tolist() == [0.0, 1.0, 0.5]
    for task in ("HalfCheetah", "Hopper", "Reacher", "Swimmer", "Walker2d"):
        committed = reference_score(f"Sparse{task}-v5")
        assert committed is not None and committed.demonstrators > committed.random
        assert reference_score(f"sb3_actpc.envs:Sparse{task}-v5") == committed
    assert reference_score("Unknown-v0") is None
