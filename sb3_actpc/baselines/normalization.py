"""Observations normalized by the demonstrations, as a features extractor of SB3."""

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs

SMALLEST_SPREAD = 1e-3  # an entry that hardly varies in the demonstrations is not scaled up
LARGEST_INPUT = 10.0  # as in SB3's VecNormalize


class NormalizedObservations(FlattenExtractor):
    """Flat observations with the demonstrations' mean and standard deviation taken out; as they are until :meth:`fit`.

    :param observation_space: a Box, or a Dict of Boxes, whose entries are joined in its order
    """

    mean: th.Tensor
    spread: th.Tensor

    def __init__(self, observation_space: spaces.Space) -> None:
        super().__init__(observation_space)
        self.keys = list(observation_space) if isinstance(observation_space, spaces.Dict) else []
        self.register_buffer("mean", th.zeros(self.features_dim))
        self.register_buffer("spread", th.ones(self.features_dim))

    def fit(self, observations: np.ndarray) -> None:
        """Give these observations, (N, obs_dim), mean 0 and standard deviation 1."""
        rows = th.as_tensor(observations, device=self.mean.device)
        self.mean.copy_(rows.mean(dim=0))
        self.spread.copy_(rows.std(dim=0, correction=0).clamp(min=SMALLEST_SPREAD))

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """(B, obs_dim) from (B, *shape) or a dict of such; rows (B, obs_dim) are taken for joined ones."""
        if isinstance(observations, dict):
            observations = th.cat([observations[key].flatten(1).float() for key in self.keys], dim=1)
        return ((super().forward(observations) - self.mean) / self.spread).clamp(-LARGEST_INPUT, LARGEST_INPUT)
