"""Features extractors of the user."""

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from tests.actpc.agents import imitating


class Dropping(BaseFeaturesExtractor):
    """Half of the observation drops out while it is trained, and it counts what it has seen."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 3)
        self.layers = th.nn.Sequential(th.nn.Flatten(), th.nn.BatchNorm1d(3), th.nn.Dropout(0.5))

    def forward(self, observations):
        return self.layers(observations)


def test_an_extractor_is_fixed():
    model = imitating(policy_kwargs={"features_extractor_class": Dropping})
    norm = model.actor.features_extractor.layers[1]
    before = norm.running_mean.clone()
    observations = th.randn(50, 3)
    features = model.actor.features(observations)
    model.policy.set_training_mode(True)
    assert th.equal(model.actor.features(observations), features)
    model.learn(30)
    assert th.equal(norm.running_mean, before)
