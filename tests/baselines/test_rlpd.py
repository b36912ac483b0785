"""SAC in the way of RLPD: layer-normalised critics, two of them drawn for each target, half of the batch demonstrated."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_actpc.baselines import RLPD
from tests.checkpoints.runs import assert_same, learn_in_two, learn_straight
from tests.recordings import record

SMALL = {"learning_starts": 10, "batch_size": 16, "seed": 1, "gradient_steps": 2}


def make(**policy_kwargs: object) -> RLPD:
    policy_kwargs = {"net_arch": [8], "n_critics": 4, **policy_kwargs}
    return RLPD("MlpPolicy", "Pendulum-v1", demonstrations=record("Pendulum-v1"), policy_kwargs=policy_kwargs, **SMALL)


def test_every_hidden_layer_of_every_critic_is_normalised_before_its_activation() -> None:
    for network in make(net_arch=[8, 6]).critic.q_networks:
        assert [type(layer) for layer in network] == [
            *[nn.Linear, nn.LayerNorm, nn.ReLU] * 2,
            nn.Linear,
        ]


def test_the_target_is_of_two_drawn_critics_and_the_critics_all_learn() -> None:
    model = make()
    observations, actions = th.randn(5, 3), th.rand(5, 1)
    every = model.critic_target.__class__.__mro__[1].forward(model.critic_target, observations, actions)
    assert len(every) == 4 and len(model.critic(observations, actions)) == 4
    seen = set()
    for _ in range(50):
        drawn = model.critic_target(observations, actions)
        assert len(drawn) == 2
        seen.add(tuple(next(i for i, one in enumerate(every) if th.equal(one, value)) for value in drawn))
    assert len({frozenset(pair) for pair in seen}) == 6  # every pair of four
    before = [network[0].weight.clone() for network in model.critic.q_networks]
    model.learn(12)
    assert model._n_updates == 4
    assert not any(th.equal(old, now[0].weight) for old, now in zip(before, model.critic.q_networks, strict=True))


def test_it_plays_the_same_after_loading_and_resumes_bit_for_bit(tmp_path) -> None:
    straight = learn_straight(make, tmp_path / "straight", 24)
    assert_same(straight, learn_in_two(make, tmp_path / "two", 24, 15))
    straight.save(tmp_path / "model.zip")
    loaded = RLPD.load(tmp_path / "model.zip")
    observation = straight.env.reset()
    assert (straight.predict(observation, deterministic=True)[0] == loaded.predict(observation, deterministic=True)[0]).all()
    assert loaded.critic_target.n_drawn == 2


class InRows(gym.ActionWrapper):
    """Takes its actions in a matrix."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.action_space = gym.spaces.Box(-2.0, 2.0, (1, 2), np.float32)

    def action(self, action: np.ndarray) -> np.ndarray:
        return action.ravel()[:1]


def test_actions_of_any_shape_are_taken_whole() -> None:
    model = RLPD("MlpPolicy", InRows(gym.make("Pendulum-v1")), policy_kwargs={"net_arch": [8]}, **SMALL).learn(12)
    assert model.critic.q_networks[0][0].in_features == 3 + 2
    assert model._n_updates == 4


def test_more_target_critics_than_critics_are_refused() -> None:
    with pytest.raises(ValueError, match="n_target_critics=5 must be between 1 and n_critics=4"):
        make(n_target_critics=5)
