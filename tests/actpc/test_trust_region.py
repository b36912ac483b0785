"""The trust region: what is measured, and where the multiplier comes to rest."""

import math

import pytest
import torch as th

from sb3_actpc.actpc.trust_region import (
    DEVIATION_RATE,
    FALL,
    FOLLOWING_RATE,
    HELD_UNIT,
    LARGEST_UNHELD,
    MULTIPLIERS,
    RADII,
    RISE,
    SMALLEST_SPREAD,
    SMALLEST_UNIT,
    TrustRegion,
    spread_of,
)

ZEROS = th.zeros(4, 2)


WORTH = th.full((4,), 7.0)  # all states the same


def measured_by(spread, guesses=False, holds=False, radius=1):
    """Of radius 1, if not said otherwise."""
    region = TrustRegion(radius, 2)
    region.measure_by(th.tensor(spread), guesses, holds)
    return region


def test_the_spread_is_the_residuals_root_mean_square_in_every_dimension_and_has_a_least():
    residuals = th.tensor([[0.3, 0.001], [-0.4, 0.001]])
    assert spread_of(residuals).tolist() == pytest.approx([math.sqrt(0.125), SMALLEST_SPREAD])


def test_the_deviation_is_counted_in_variances_of_each_dimension():
    """One standard deviation in every dimension is a deviation of 1, whatever its spread; the start is forgotten."""
    region = measured_by([0.1, 0.5])
    region.regulate(th.tensor([[0.1, -0.5]] * 4), ZEROS, WORTH)
    assert float(region.deviation) == pytest.approx(DEVIATION_RATE)
    for _ in range(1000):
        region.regulate(th.tensor([[0.1, -0.5]] * 4), ZEROS, WORTH)
    assert float(region.deviation) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("scale", [0.1, 1.0, 50.0])
@pytest.mark.parametrize("shift", [-30.0, 0.0, 30.0])
def test_a_state_counts_by_its_worth_above_the_worst(shift, scale):
    """Worth 0, 1, 2, 5 and squares 9, 1, 1, 4: (1 + 2 + 20) / 8, whatever values are shifted or scaled by."""
    region = TrustRegion(1, 2)
    actions = th.tensor([3.0, 1.0, -1.0, 2.0])[:, None].expand(4, 2)
    region.regulate(actions, ZEROS, shift + scale * th.tensor([0.0, 1.0, 2.0, 5.0]))
    assert float(region.deviation) == pytest.approx(DEVIATION_RATE * 23 / 8, rel=1e-3)


def test_a_small_spread_counts_as_the_smallest_unit():
    region = measured_by([SMALLEST_SPREAD] * 2)
    region.regulate(th.full((4, 2), SMALLEST_UNIT), ZEROS, WORTH)
    assert float(region.deviation) == pytest.approx(DEVIATION_RATE)


@pytest.mark.parametrize("region", [TrustRegion(1, 2), measured_by([th.inf] * 2), measured_by([0.1, 0.1], guesses=True)])
def test_an_unknown_spread_counts_as_one(region):
    """Before anything is imitated, and where the clone guesses what is done between the demonstrations."""
    region.regulate(th.full((4, 2), 0.5), ZEROS, WORTH)
    assert float(region.deviation) == pytest.approx(0.25 * DEVIATION_RATE)


@pytest.mark.parametrize(("spread", "unit"), [(0.01, HELD_UNIT), (0.14, HELD_UNIT), (0.3, 0.3), (1.7, 1.0)])
def test_where_the_habit_holds_a_learner_that_guesses_the_unit_is_small_unless_demonstrators_do_this_and_that(spread, unit):
    """The radius comes to half of the actions' range at most, whatever it is counted in."""
    region = measured_by([spread] * 2, guesses=True, holds=True)
    region.regulate(th.full((4, 2), unit), ZEROS, WORTH)
    assert float(region.deviation) == pytest.approx(DEVIATION_RATE)
    for _ in range(3000):
        region.follow(1.0)
    assert float(region.radius) == pytest.approx(unit**-2)


def test_the_widest_radius_is_half_of_the_actions_range_in_every_dimension():
    region = measured_by([0.2, 0.8], guesses=True, holds=True)
    for _ in range(3000):
        region.follow(1.0)
    for _ in range(2000):
        region.regulate(th.ones(4, 2), ZEROS, WORTH)
    assert float(region.radius) == pytest.approx(float(region.deviation), rel=1e-4)


def test_the_multiplier_grows_inside_falls_outside_and_rests_on_the_border():
    rates = []
    for deviation in (0.0, 0.5, 1.0, 1.5, 2.0, 9.0):
        region = TrustRegion(1, 2)
        region.deviation.fill_(deviation)
        before = float(region.multiplier)
        after = float(region.regulate(th.full((4, 2), math.sqrt(deviation)), ZEROS, WORTH))
        rates.append(math.log(after / before))
    assert rates == pytest.approx([RISE, RISE / 2, 0.0, -FALL / 2, -FALL, -FALL], abs=1e-5)


def test_a_wider_radius_is_reached_by_an_actor_that_follows_the_pressure():
    """A play in which the deviation is the multiplier squared: it settles where the deviation is the radius."""
    for radius in (0.25, 4.0):
        region = TrustRegion(radius, 2)
        for _ in range(6000):
            region.regulate(region.multiplier.expand(4, 2), ZEROS, WORTH)
        assert float(region.multiplier) == pytest.approx(math.sqrt(radius), rel=0.01)


@pytest.mark.parametrize(
    ("make", "largest"),
    [
        (lambda: measured_by([1.0, 1.0]), MULTIPLIERS[1]),
        (lambda: measured_by([1.0, 1.0], guesses=True, holds=True), MULTIPLIERS[1]),
        (lambda: measured_by([1.0, 1.0], guesses=True), LARGEST_UNHELD),
        (lambda: TrustRegion(1, 2), LARGEST_UNHELD),
    ],
)
def test_multiplier_and_radius_stay_within_bounds(make, largest):
    """Where the unit is unknown the region is too wide to hold the actor: the multiplier has a bound of its own. Where the
    habit holds it the radius never falls below the first, and comes to half of the actions' range at most."""
    for verdict, gain, actions, multiplier in (("tied", 1, ZEROS, largest), ("rejected", -1, ZEROS + 1e6, MULTIPLIERS[0])):
        region = make()
        for _ in range(3000):
            region.regulate(actions, ZEROS, WORTH)
            region.resize(verdict)
            region.follow(gain)
        smallest, largest_radius = (1.0, 1.0) if region.holds else RADII
        assert float(region.radius) == pytest.approx(largest_radius if gain > 0 else smallest)
        assert float(region.multiplier) == pytest.approx(multiplier)


def test_holding_its_own_widens_the_radius_and_losing_shrinks_it():
    for verdict, grows in (("accepted", True), ("tied", True), ("rejected", False)):
        region = TrustRegion(1, 2)
        region.resize(verdict)
        assert (float(region.radius) > 1.0) == grows


def test_where_the_habit_holds_the_learner_the_radius_follows_its_episodes_and_no_verdict():
    """As many wins as losses of the same size leave it where it was, but for the first radius, below which it never falls."""
    region, free = (measured_by([0.1, 0.1], guesses=True, holds=holds) for holds in (True, False))
    radii = []
    for gain in (0.5, 0.5, -0.5, -1.0, 1.0):
        region.resize("tied")
        region.follow(gain)
        free.follow(gain)
        radii.append(math.log(float(region.radius)) / FOLLOWING_RATE)
    assert radii == pytest.approx([0.5, 1.0, 0.5, 0.0, 1.0], abs=1e-4)
    assert float(free.radius) == 1.0


def test_a_first_radius_beyond_all_that_can_be_held_stays():
    region = measured_by([0.1, 0.1], guesses=True, holds=True, radius=100)
    for gain in (1.0, -1.0):
        region.follow(gain)
        assert float(region.radius) == 100.0


def test_what_is_returned_does_not_change_with_the_next_update():
    region = TrustRegion(1, 2)
    first = region.regulate(ZEROS, ZEROS, WORTH)
    kept = float(first)
    region.regulate(ZEROS, ZEROS, WORTH)
    assert float(first) == kept < float(region.multiplier)


@pytest.mark.parametrize("radius", [0.05, 2000.0])
def test_a_radius_that_no_verdict_could_leave_is_named(radius):
    with pytest.raises(ValueError, match=f"trust_radius={radius} must be from 0.1 to 1000, or 0 for a fixed pressure"):
        TrustRegion(radius, 2)
