"""Observations normalized by fixed statistics."""

import torch as th
from torch import nn

OBSERVATION_CLIP = 10.0  # as in SB3's VecNormalize
# standard deviations at least, of a feature that has changed: of its largest size, and at all; a smaller one may be rounding
SMALLEST_CHANGE, SMALLEST_DEVIATION = 1e-4, 1e-7


class ObservationNormalizer(nn.Module):
    """(o - mean) / std by fixed statistics, clipped to ±10; the identity until :meth:`fit` is called."""

    mean: th.Tensor
    scale: th.Tensor
    clip: th.Tensor

    def __init__(self, n_features: int) -> None:
        super().__init__()
        self.register_buffer("mean", th.zeros(n_features))
        self.register_buffer("scale", th.ones(n_features))
        self.register_buffer("clip", th.full((), float("inf")))

    def fit(self, features: th.Tensor | None) -> None:
        """:param features: (N, n_features), not normalised, whose mean and standard deviation are used from now on; None for
        the identity"""
        if features is None:
            self.mean.zero_()
            self.scale.fill_(1.0)
            self.clip.fill_(float("inf"))
            return
        self.mean.copy_(features.mean(0))
        std = features.std(0, correction=0)
        has_changed = std > (SMALLEST_CHANGE * features.abs().amax(0)).clamp_min(SMALLEST_DEVIATION)
        self.scale.copy_(th.where(has_changed, 1.0 / std, 1.0))  # a feature that never changed says nothing of its scale
        self.clip.fill_(OBSERVATION_CLIP)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:param features: (..., n_features)
        :return: the same shape, normalised"""
        return th.clamp((features - self.mean) * self.scale, -self.clip, self.clip)
