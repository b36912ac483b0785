"""IBRL: a frozen BC policy proposes actions when the agent acts and when it bootstraps."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_actpc.baselines import IBRL
from sb3_actpc.demonstrations import Demonstrations
from tests.recordings import record

ENV = "Pendulum-v1"


def make(**options: Any) -> IBRL:
    small = {"policy_kwargs": {"net_arch": [8], "n_critics": 3}, "learning_starts": 5, "batch_size": 8, "bc_steps": 20}
    return IBRL("MlpPolicy", ENV, buffer_size=100, seed=1, **{"demonstrations": record(ENV), **small, **options})


@pytest.mark.parametrize("n_steps", [1, 3])
def test_the_bc_policy_is_trained_once_and_then_stays_as_it_is(tmp_path: Path, n_steps: int) -> None:
    model, rows = make(n_steps=n_steps), th.as_tensor(record(ENV).observations[:4])
    untrained = model.policy.bc_actions(rows)
    frozen = model.learn(8).policy.bc_actions(rows)
    assert not th.equal(untrained, frozen)
    model.learn(8, reset_num_timesteps=False)
    assert th.equal(model.policy.bc_actions(rows), frozen)
    model.save(tmp_path / "model.zip")
    loaded = IBRL.load(tmp_path / "model.zip")
    assert np.array_equal(*(one.predict(rows.numpy(), deterministic=True)[0] for one in (model, loaded)))


def test_it_takes_the_proposal_that_the_critics_value_more() -> None:
    model, rows = make(), record(ENV).observations
    seen = th.as_tensor(rows)
    with th.no_grad():
        own, proposed = model.actor(seen), model.policy.bc_actions(seen)
        values = [th.cat(model.critic_target(seen, actions), dim=1).amin(dim=1) for actions in (own, proposed)]
    is_proposed = (values[1] > values[0])[:, None]
    assert 0 < is_proposed.sum() < len(rows)
    chosen, _ = model.predict(rows, deterministic=True)
    np.testing.assert_allclose(chosen, 2.0 * th.where(is_proposed, proposed, own).numpy(), rtol=1e-6)


def test_until_learning_starts_it_acts_as_the_bc_policy(tmp_path: Path) -> None:
    model, rows = make(learning_starts=50).learn(8), record(ENV).observations
    model.save(tmp_path / "model.zip")
    cloned = 2.0 * model.policy.bc_actions(th.as_tensor(rows)).numpy()
    for one in (model, IBRL.load(tmp_path / "model.zip")):
        np.testing.assert_allclose(one.predict(rows, deterministic=True)[0], cloned, rtol=1e-5)
    model.learn(60, reset_num_timesteps=False)
    assert not np.allclose(model.predict(rows, deterministic=True)[0], cloned, rtol=1e-5)


def test_rewards_alone_may_be_normalized() -> None:
    env = VecNormalize(make_vec_env(ENV), norm_obs=False)
    assert IBRL("MlpPolicy", env, demonstrations=record(ENV), learning_starts=5, bc_steps=5).learn(8).num_timesteps == 8


def test_critics_are_layer_normalized() -> None:
    assert sum(isinstance(module, th.nn.LayerNorm) for module in make().policy.critic.modules()) == 3


def test_without_demonstrations_it_is_refused() -> None:
    with pytest.raises(ValueError, match="demonstrations=None: IBRL needs demonstrations"):
        make(demonstrations=None)


def test_dict_observations_are_refused() -> None:
    with pytest.raises(ValueError, match=r"IBRL takes Box observations, found Dict.*FlattenObservation"):
        IBRL("MultiInputPolicy", "GoalReacher-v5", demonstrations=record(ENV))


class Matrices(gym.ObservationWrapper):
    """The Pendulum's observations three times over, (3, 3)."""

    def __init__(self) -> None:
        super().__init__(gym.make(ENV))
        self.observation_space = gym.spaces.Box(-8.0, 8.0, (3, 3))

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return np.stack([observation] * 3)


def test_observations_may_have_several_axes() -> None:
    shown = Demonstrations.record(lambda _: np.zeros(1), Matrices(), 2)
    model = IBRL("MlpPolicy", Matrices(), demonstrations=shown, learning_starts=5, bc_steps=5, batch_size=8)
    assert model.learn(8).num_timesteps == 8


class Unpaid(gym.RewardWrapper):
    """The Pendulum without rewards."""

    def __init__(self) -> None:
        super().__init__(gym.make(ENV))

    def reward(self, reward: Any) -> float:
        return 0.0


def test_one_pair_of_critics_chooses_the_next_action_and_another_values_it() -> None:
    """Of three target critics the first values the actor's action more, the others that of the BC policy. Pairs (0, 1) and
    (1, 2) choose the BC policy's action, of value 1 or 3, pair (0, 2) the actor's, of value 0 or 2. All nine choices of two
    pairs have a mean value of 4/3; if the pair that chooses also valued, it would be 2."""
    shown = Demonstrations.record(lambda _: np.zeros(1), Unpaid(), 2)
    small = {"policy_kwargs": {"net_arch": [16], "n_critics": 3}, "learning_starts": 5, "bc_steps": 5, "buffer_size": 100}
    model = IBRL("MlpPolicy", Unpaid(), demonstrations=shown, gamma=0.9, batch_size=64, seed=1, **small).learn(8)
    table = th.tensor([[5.0, 1.0], [0.0, 3.0], [2.0, 4.0]])  # (critics, actions)

    def values(_: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        return tuple(critic.repeat_interleave(len(actions) // 2)[:, None] for critic in table)

    model.critic_target.forward = values  # type: ignore[method-assign]
    learned = []
    for _ in range(10):
        model.train(100, 64)
        batch = model.replay_buffer.sample(64)
        with th.no_grad():
            learned.append(float(th.cat(model.critic(batch.observations, batch.actions)).mean()))
    assert np.mean(learned[5:]) / 0.9 == pytest.approx(4 / 3, abs=0.2)
