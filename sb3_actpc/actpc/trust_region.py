"""How far the learning actor may go from its habit, and the pressure that takes it there."""

import math

import torch as th
from torch import nn

# of actions in [-1, 1], where demonstrations hardly spread around their clone: for the noise, and as the trust region's unit
SMALLEST_SPREAD, SMALLEST_UNIT = 0.02, 0.05
# the smallest where the habit holds a learning actor that guesses: about what clones of an arm's episodes miss by on others
HELD_UNIT = 0.15
SMALLEST_VALUE = 1e-6
DEVIATION_RATE = 0.02  # of the running deviation, per update
# of the multiplier's logarithm, per update: while nothing of the radius is used, and while twice of it is. A critic that has
# just begun points anywhere, so that pressure comes slowly and goes at once
RISE, FALL = 0.003, 0.01
MULTIPLIERS, FIRST_MULTIPLIER = (0.02, 200.0), 0.05
# the largest where the unit is unknown: there the region is too wide to hold the actor, and refresh must still be felt
LARGEST_UNHELD = 3.0
RADII = 0.1, 1000.0  # below a third of a standard deviation nothing is learned
# what a verdict about a candidate (:mod:`sb3_actpc.actpc.habit`) does to the radius
RADIUS_FACTORS = {"accepted": 1.25, "tied": 2.0, "undecided": 1.0, "rejected": 0.7, "recalled": 0.7}
# of the radius's logarithm, where the habit holds the learning actor: for an episode of that one which is paid twice what the
# habit is, or nothing. Some 250 episodes of a gain of a fifth are a radius ten times as wide
FOLLOWING_RATE = 0.05


def spread_of(residuals: th.Tensor) -> th.Tensor:
    """
    :param residuals: demonstrated actions minus the clone's, (N, A)
    :return: their standard deviations, ``SMALLEST_SPREAD`` at least, (A,)
    """
    return residuals.square().mean(0).sqrt().clamp_min(SMALLEST_SPREAD)


class TrustRegion(nn.Module):
    """
    The critic's pressure as the multiplier of a trust region, regulated as SAC regulates its temperature.

    The deviation is the mean squared difference of the learning actor's actions from the habit's, in units of the variance
    that the demonstrated actions have around their clone, dimension by dimension. Where the clone guesses between the
    demonstrations that says little: the unit is ``HELD_UNIT`` at least, and more where demonstrators do now this and now
    that; or 1, half of the actions' range, where the habit does not hold the learning actor there. A state counts by what the
    critic says it is worth, from the batch's worst up: where all is lost nothing is imitated, and refresh alone lets the actor
    drift there. The multiplier grows slowly while the deviation is below the radius, and falls quickly while it is above. So a
    set of demonstrations that holds one action for a state allows little, one that holds many allows much; and the radius
    follows outcomes: it widens with candidates that hold their own, and shrinks with those that do not. Of the radius the
    critic has what its calibration leaves it (``trust``, :mod:`sb3_actpc.actpc.calibration`): none where it is surely wrong.
    Where the unit is unknown the multiplier has a bound of its own (``LARGEST_UNHELD``).

    Where the habit holds the learning actor the radius begins small, and follows every episode of that one in the place of
    verdicts, which are few where clones guess: it widens with what they are paid more than the habit, and shrinks with what
    they are paid less, to the first radius and no further. A critic that has seen a few dozen of an arm's episodes loses
    with its actor however small the region is, and has to go on in one that it can learn in.

    :param radius: at first, and where the habit holds the learning actor the smallest, a mean squared distance in that unit
    :param n_actions: A
    :raises ValueError: for a radius outside ``RADII``, within which outcomes move it
    """

    unit: th.Tensor
    largest: th.Tensor
    radius: th.Tensor
    deviation: th.Tensor
    multiplier: th.Tensor
    holds: th.Tensor
    trust: th.Tensor

    def __init__(self, radius: float, n_actions: int) -> None:
        smallest, largest = RADII
        if not smallest <= radius <= largest:
            raise ValueError(f"trust_radius={radius!r} must be from {smallest:g} to {largest:g}, or 0 for a fixed pressure")
        super().__init__()
        self.first_radius = radius
        self.register_buffer("unit", th.ones(n_actions))  # standard deviations; half of the range while they are unknown
        self.register_buffer("largest", th.tensor(LARGEST_UNHELD))  # multiplier
        self.register_buffer("radius", th.tensor(float(radius)))
        self.register_buffer("deviation", th.tensor(0.0))
        self.register_buffer("multiplier", th.tensor(0.0))
        self.register_buffer("trust", th.tensor(1.0), persistent=False)  # the share of the radius that the critic has
        self.register_buffer("holds", th.tensor(0.0))  # 1 where the habit teaches the learning actor, which goes with the unit
        self.begin()

    def begin(self) -> None:
        """With an actor that does what its habit does. What another one has won by its episodes says nothing of this one."""
        self.deviation.zero_()
        self.multiplier.fill_(FIRST_MULTIPLIER)
        if self.holds:
            self.radius.fill_(self.first_radius)

    def measure_by(self, spread: th.Tensor, guesses: bool, holds: bool) -> None:
        """
        :param spread: standard deviations of the demonstrated actions around their clone, (A,)
        :param guesses: whether the clone has to guess between the demonstrations (:mod:`sb3_actpc.actpc.room`): how well it
            knows the steps that are shown then says nothing about the others
        :param holds: whether the habit teaches the learning actor
        """
        self.largest.fill_(LARGEST_UNHELD if guesses and not holds else MULTIPLIERS[1])
        self.unit.copy_(spread.clamp(HELD_UNIT if guesses else SMALLEST_UNIT, 1.0))
        if guesses and not holds:
            self.unit.fill_(1.0)
        self.holds.fill_(float(holds))

    def regulate(self, actions: th.Tensor, habit_actions: th.Tensor, values: th.Tensor) -> th.Tensor:
        """
        :param actions: of the learning actor, (B, A)
        :param habit_actions: of the habit in the same states, (B, A)
        :param values: what the states are worth, (B,)
        :return: the multiplier, 0-d
        """
        weights = values - values.min() + SMALLEST_VALUE  # the same for all where all are worth the same
        squares = ((actions - habit_actions) / self.unit).square().mean(1)
        self.deviation.lerp_((squares * weights).mean() / weights.mean(), DEVIATION_RATE)
        allowed = self.radius * self.trust
        unused = (1.0 - self.deviation / allowed.clamp_min(SMALLEST_VALUE)).clamp_min(-1.0)
        self.multiplier.mul_((RISE * unused.clamp_min(0.0) + FALL * unused.clamp_max(0.0)).exp())
        self.multiplier.clamp_min_(MULTIPLIERS[0]).clamp_max_(self.largest)
        return self.multiplier.clone()

    def resize(self, verdict: str) -> None:
        """
        Where the habit does not hold the learning actor.

        :param verdict: about a candidate or a habit that was one, a key of ``RADIUS_FACTORS``
        """
        if not self.holds:
            self.radius.mul_(self._trusted(RADIUS_FACTORS[verdict])).clamp_(*RADII)

    def follow(self, gain: float) -> None:
        """
        Where the habit holds the learning actor.

        :param gain: of an episode of the learning actor over the habit's mean return, as a share of that: from -1 to 1
        """
        if self.holds:
            factor = self._trusted(math.exp(FOLLOWING_RATE * gain))
            largest = float(self.unit.pow(-2).mean())  # half of the actions' range: beyond it nothing is held
            self.radius.mul_(factor).clamp_(self.first_radius, max(self.first_radius, largest))

    def _trusted(self, factor: float) -> float:
        """Where the critic has little of the radius, outcomes are not its own, and widen it little."""
        return factor ** float(self.trust) if factor > 1.0 else factor
