"""How far the learning actor may go from its habit, and the pressure that takes it there."""

import torch as th
from torch import nn

SMALLEST_SPREAD = 0.02  # of actions in [-1, 1], where demonstrations hardly spread around their clone
DEVIATION_RATE = 0.02  # of the running deviation, per update
# of the multiplier's logarithm, per update: while nothing of the radius is used, and while twice of it is. A critic that has
# just begun points anywhere, so that pressure comes slowly and goes at once
RISE, FALL = 0.003, 0.01
FIRST_MULTIPLIER, MULTIPLIERS = 0.1, (0.02, 200.0)
RADII = 0.1, 1000.0  # below a third of a standard deviation nothing is learned
# what a verdict about a candidate (:mod:`sb3_actpc.actpc.habit`) does to the radius
RADIUS_FACTORS = {"accepted": 1.25, "tied": 2.0, "rejected": 0.7}


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
    that the demonstrated actions have around their clone, dimension by dimension. The multiplier begins small, grows slowly
    while the deviation is below the radius, and falls quickly while it is above. So a set of demonstrations that holds one
    action for a state allows little, one that holds many allows much; and the radius follows outcomes: it widens with
    candidates that hold their own, and shrinks with those that do not.

    :param radius: at first
    """

    radius: th.Tensor
    deviation: th.Tensor
    multiplier: th.Tensor

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.register_buffer("radius", th.tensor(float(radius)))
        self.register_buffer("deviation", th.tensor(0.0))
        self.register_buffer("multiplier", th.tensor(FIRST_MULTIPLIER))

    def regulate(self, actions: th.Tensor, habit_actions: th.Tensor, spread: th.Tensor) -> th.Tensor:
        """
        :param actions: of the learning actor, (B, A)
        :param habit_actions: of the habit in the same states, (B, A)
        :param spread: standard deviations of the demonstrated actions, (A,); 1 where they are unknown
        :return: the multiplier, 0-d
        """
        deviation = ((actions - habit_actions) / spread.clamp_max(1.0)).square().mean()
        self.deviation.lerp_(deviation, DEVIATION_RATE)
        unused = (1.0 - self.deviation / self.radius).clamp_min(-1.0)
        self.multiplier.mul_((RISE * unused.clamp_min(0.0) + FALL * unused.clamp_max(0.0)).exp()).clamp_(*MULTIPLIERS)
        return self.multiplier.clone()

    def resize(self, verdict: str) -> None:
        """:param verdict: about a candidate, a key of ``RADIUS_FACTORS``"""
        self.radius.mul_(RADIUS_FACTORS[verdict]).clamp_(*RADII)
