"""Observations normalized by the demonstrations, as a features extractor of SB3."""

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_actpc.utils.normalization import ObservationNormalizer


class NormalizedObservations(FlattenExtractor):
    """Flat observations with the demonstrations' mean and standard deviation taken out; as they are until :meth:`fit`.

    :param observation_space: a Box, or a Dict of Boxes, whose entries are joined in its order
    """

    def __init__(self, observation_space: spaces.Space) -> None:
        super().__init__(observation_space)
        self.keys = list(observation_space) if isinstance(observation_space, spaces.Dict) else []
        self.normalizer = ObservationNormalizer(self.features_dim)

    def fit(self, observations: np.ndarray) -> None:
        """Give these observations, (N, obs_dim), mean 0 and standard deviation 1."""
        self.normalizer.fit(th.as_tensor(observations, device=self.normalizer.mean.device))

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """(B, obs_dim) from (B, *shape) or a dict of such; rows (B, obs_dim) are taken for joined ones."""
        if isinstance(observations, dict):
            observations = th.cat([observations[key].flatten(1).float() for key in self.keys], dim=1)
        return self.normalizer(super().forward(observations))
