"""Every batch holds the asked share of demonstrations, as the environment would have shown and paid them. Bad action spaces
are refused, and the caller's settings stay."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env

from sb3_actpc.baselines import BC, LOGO, DDPGDemo, TD3Demo
from sb3_actpc.baselines.demonstrated import DemonstrationNStepReplayBuffer, DemonstrationReplayBuffer
from sb3_actpc.demonstrations import Demonstrations, fit_demonstrations
from tests.recordings import record

BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)
WIDE = spaces.Box(-2.0, 2.0, (1,), np.float32)
SMALL: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 1000, "buffer_size": 200, "seed": 0}


def numbered(n: int, reward: float = 7.0) -> Demonstrations:
    """One episode of n transitions whose observations are 100, 101, ... and whose actions are 1 of at most 2."""
    rows = np.repeat(np.arange(100.0, 101.0 + n)[:, None], 2, axis=1)
    rewards, ends = np.full(n, reward), np.zeros(n, dtype=bool)
    return Demonstrations(rows[:-1], np.ones((n, 1)), rows[1:], rewards, ends, np.zeros(1, dtype=int), "Numbered-v0")


def fill(buffer: DemonstrationReplayBuffer, n: int) -> None:
    for step in range(n):
        row = np.full((1, 2), float(step))
        buffer.add(row, row + 1, np.zeros((1, 1)), np.zeros(1), np.zeros(1), [{}])


@pytest.mark.parametrize(("fraction", "n_shown"), [(0.0, 0), (0.25, 4), (0.5, 8), (1.0, 16)])
def test_the_share_of_demonstrations_is_the_asked_one_and_they_come_last(fraction: float, n_shown: int) -> None:
    buffer = DemonstrationReplayBuffer(50, BOX, WIDE, demonstrations=numbered(5), demonstration_fraction=fraction)
    fill(buffer, 20)
    batch = buffer.sample(16)
    shown = batch.observations[:, 0] >= 100
    assert shown.tolist() == [False] * (16 - n_shown) + [True] * n_shown
    assert buffer.n_demonstrated(16) == n_shown
    assert (batch.rewards[:, 0] == 7.0).tolist() == shown.tolist()
    assert (batch.actions[:, 0] == 0.5).tolist() == shown.tolist()  # scaled
    assert (batch.dones == 0).all()  # a time limit is no end
    assert th.equal(batch.next_observations, batch.observations + 1)


def test_n_step_returns_of_demonstrations_are_n_step_returns() -> None:
    """In an episode of 5 rewards of 7, each sums the three that follow, fewer at its end."""
    buffer = DemonstrationNStepReplayBuffer(
        50, BOX, WIDE, n_steps=3, gamma=0.5, demonstrations=numbered(5), demonstration_fraction=1.0
    )
    batch = buffer.sample(200)
    counts = th.clamp(105 - batch.observations[:, :1], max=3)
    assert th.allclose(batch.rewards, 7 * (2 - 2 * 0.5**counts))
    assert th.allclose(batch.discounts, 0.5**counts)


@pytest.mark.parametrize("algorithm", [TD3, DDPG, SAC])
def test_sb3s_own_algorithms_learn_from_the_buffer(algorithm: type) -> None:
    shown = fit_demonstrations(record("Pendulum-v1"), None, spaces.Box(-8, 8, (3,)), spaces.Box(-2, 2, (1,)))
    buffer = {"replay_buffer_class": DemonstrationReplayBuffer, "replay_buffer_kwargs": {"demonstrations": shown}}
    model = algorithm("MlpPolicy", "Pendulum-v1", batch_size=8, learning_starts=5, **buffer).learn(10)
    assert model.replay_buffer.n_demonstrated(8) == 4
    assert len(model.replay_buffer.sample(8).observations) == 8


def test_demonstrations_are_paid_by_the_environment_that_learns() -> None:
    """Recorded with 0 for a miss, they are worth -1 to an agent that gets -1 for it."""
    env = make_vec_env("SparseReacher-v5", env_kwargs={"miss_reward": -1.0})
    model = TD3Demo("MlpPolicy", env, demonstrations=record("SparseReacher-v5"), demonstration_fraction=1.0)
    assert model.replay_buffer is not None
    rewards = model.replay_buffer.sample(200).rewards
    assert set(rewards.flatten().tolist()) <= {-1.0, 1.0} and (rewards == -1.0).any()
    env.close()


def test_an_agent_loaded_to_play_has_no_buffer_until_it_has_an_environment(tmp_path) -> None:
    """rl-zoo3 plays agents without one: neither the memory nor the demonstrations' file may be needed."""
    path = tmp_path / "shown.npz"
    record("Pendulum-v1").save(path)
    model = TD3Demo("MlpPolicy", "Pendulum-v1", demonstrations=path, policy_kwargs={"net_arch": [8]}, batch_size=8)
    model.save(tmp_path / "model.zip")
    held = path.read_bytes()
    path.unlink()
    loaded = TD3Demo.load(tmp_path / "model.zip")
    assert loaded.replay_buffer.buffer_size == 1
    observation = model.env.reset()
    assert np.array_equal(model.predict(observation)[0], loaded.predict(observation)[0])
    path.write_bytes(held)
    loaded.set_env(model.env)
    assert loaded.replay_buffer.buffer_size == model.buffer_size
    assert loaded.replay_buffer.demonstrated.buffer_size == 24


def test_a_loaded_agent_takes_another_length_of_returns(tmp_path) -> None:
    shown = record("Pendulum-v1")
    model = TD3Demo("MlpPolicy", "Pendulum-v1", demonstrations=shown, policy_kwargs={"net_arch": [8]}, n_steps=3)
    model.save(tmp_path / "model.zip")
    loaded = TD3Demo.load(tmp_path / "model.zip", env=model.env, demonstrations=shown, n_steps=5, gamma=0.9)
    for buffer in (loaded.replay_buffer, loaded.replay_buffer.demonstrated):
        assert (buffer.n_steps, buffer.gamma) == (5, 0.9)


def test_n_step_returns_of_dict_observations_are_refused() -> None:
    with pytest.raises(ValueError, match=r"n_steps=3 must be 1 with Dict observations"):
        TD3Demo("MultiInputPolicy", "GoalReacher-v5", n_steps=3)


class WithActions(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Pendulum with another action space."""

    def __init__(self, space: gym.spaces.Box) -> None:
        super().__init__(gym.make("Pendulum-v1"))
        self.action_space = space


@pytest.mark.parametrize("kind", [TD3Demo, BC, LOGO])
@pytest.mark.parametrize(
    ("space", "message"),
    [
        (gym.spaces.Box(np.array([1.0, -1.0]), np.array([1.0, 1.0]), dtype=np.float64), "dimension 0 has low == high"),
        (gym.spaces.Box(0, 9, (1,), np.int64), "must have a floating dtype"),
    ],
)
def test_actions_that_cannot_be_scaled_are_refused(kind: type, space: gym.spaces.Box, message: str) -> None:
    rows, actions = np.zeros((4, 3), dtype=np.float32), np.ones((4, *space.shape))
    ends, starts = np.zeros(4, dtype=bool), np.zeros(1, dtype=int)
    shown = Demonstrations(rows, actions, rows, np.zeros(4), ends, starts, env_id="Pendulum-v1")
    with pytest.raises(ValueError, match=message):
        kind("MlpPolicy", WithActions(space), demonstrations=shown)


@pytest.mark.parametrize(
    ("kind", "more"),
    [(TD3Demo, {"n_steps": 3, "replay_buffer_kwargs": {}}), (DDPGDemo, {"replay_buffer_kwargs": {}}), (BC, {}), (LOGO, {})],
)
def test_the_callers_dictionaries_stay_as_they_were(kind: type, more: dict[str, Any]) -> None:
    given: dict[str, Any] = {"policy_kwargs": {"net_arch": [8], "optimizer_kwargs": {"weight_decay": 0.1}}, **more}
    before = deepcopy(given)
    kind("MlpPolicy", "Pendulum-v1", demonstrations=record("Pendulum-v1"), **given)
    assert given == before


def test_a_loaded_buffer_outlasts_the_environment_that_is_set_and_the_demonstrations_are_the_agents(tmp_path: Path) -> None:
    few, many = record("Pendulum-v1", 1, 5), record("Pendulum-v1", 2, 10)
    model = TD3Demo("MlpPolicy", "Pendulum-v1", demonstrations=many, **SMALL).learn(30)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = TD3Demo.load(tmp_path / "model", demonstrations=many)
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.set_env(make_vec_env("Pendulum-v1"))
    assert loaded.replay_buffer.size() == 30
    other = TD3Demo.load(tmp_path / "model", env=make_vec_env("Pendulum-v1"), demonstrations=few)
    other.load_replay_buffer(tmp_path / "buffer")
    assert (other.replay_buffer.size(), other.replay_buffer.demonstrated.size()) == (30, 5)


def test_demonstrations_are_paid_by_the_environment_that_was_set() -> None:
    model = TD3Demo("MultiInputPolicy", "GoalReacher-v5", demonstrations=record("SparseReacher-v5"), **SMALL)
    model.set_env(make_vec_env("GoalReacher-v5", env_kwargs={"miss_reward": -1.0}))
    assert set(model.replay_buffer.demonstrated.rewards[:, 0].tolist()) <= {-1.0, 1.0}


class Named(gym.Wrapper):
    """An environment that says what it is in its own words."""

    def __str__(self) -> str:
        return "a pendulum <at rest>"


def test_an_environment_may_describe_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    # for this test alone: others use the id unregistered
    spec = EnvSpec("Named-v0", lambda: Named(gym.make("Pendulum-v1").unwrapped), max_episode_steps=10)
    monkeypatch.setitem(gym.registry, "Named-v0", spec)
    shown = Demonstrations.record(lambda observation: -observation[1:2], "Named-v0", n_episodes=2)
    assert TD3Demo("MlpPolicy", "Named-v0", demonstrations=shown, **SMALL).learn(5).num_timesteps == 5
