"""R-stability against cases worked by hand from the paper's formula."""

import math

import numpy as np
import pytest

from sb3_actpc.experiments.report.r_stability import (
    final_mean,
    r_stability,
    smooth,
)


def test_an_agent_that_always_gets_the_same_is_perfectly_stable() -> None:
    assert r_stability(np.full(200, 37.0)) == 0.0
    assert r_stability(np.full(350, -4.0)) == 0.0


def test_an_agent_that_never_gets_anything_has_no_r_stability() -> None:
    """The formula divides by the best return, which is 0."""
    assert math.isnan(r_stability(np.zeros(300)))
    # likewise where all but the best are below 0
    assert math.isnan(r_stability(np.r_[np.full(299, -2.0), 0.0]))


def test_half_of_the_episodes_at_zero_leave_the_smoothed_value_at_half_of_the_best() -> None:
    """0, 10, 0, 10, ...: every window of 100 has the mean 5, the best is 10: |(5 - 10) / 10|."""
    assert r_stability(np.tile([0.0, 10.0], 100)) == pytest.approx(0.5)


def test_negative_returns_as_the_reachers() -> None:
    """-8 and -2 in turn: every mean is -5, the best is -2: |(-5 + 2) / -2|."""
    assert r_stability(np.tile([-8.0, -2.0], 100)) == pytest.approx(1.5)


def test_the_smoothed_values_are_means_of_the_hundred_episodes_before_each() -> None:
    """100 episodes of 0, then 100 of 1: before the i-th of the last (i = 0 ... 99) lie i ones, so the i-th relative error is
    1 - i / 100, and their mean 1 - 99 / 200."""
    assert r_stability(np.r_[np.zeros(100), np.ones(100)]) == pytest.approx(1.0 - 0.495)


def test_only_the_last_two_hundred_episodes_count() -> None:
    returns = np.tile([0.0, 10.0], 100)
    assert r_stability(np.r_[np.full(77, 1e6), returns]) == r_stability(returns)


def test_the_best_is_that_of_the_last_hundred() -> None:
    """A best of the hundred before them is in the smoothed values only: their mean is 1.01 before the first of the last and
    1 after it, the best is 1."""
    returns = np.ones(200)
    returns[0] = 2.0
    assert r_stability(returns) == pytest.approx(0.01 / 100)


@pytest.mark.parametrize("n", [0, 1, 100, 199])
def test_with_fewer_than_two_hundred_episodes_it_is_undefined(n: int) -> None:
    assert math.isnan(r_stability(np.ones(n)))


def test_what_the_task_does_not_report_is_undefined() -> None:
    assert math.isnan(r_stability(np.full(200, np.nan)))


def test_smoothing_is_the_mean_of_as_many_as_there_are_up_to_the_window() -> None:
    assert smooth(np.array([1.0, 3.0, 5.0, 7.0]), window=2).tolist() == [1.0, 2.0, 4.0, 6.0]


def test_the_final_mean_needs_a_hundred_episodes() -> None:
    assert final_mean(np.r_[np.zeros(50), np.full(100, 4.0)]) == 4.0
    assert math.isnan(final_mean(np.ones(99)))
