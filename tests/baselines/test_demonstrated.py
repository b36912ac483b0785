"""What every baseline does: no transition is lost or misjoined, bad action spaces are refused, the caller's settings stay."""

from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes

from sb3_actpc.baselines import BC, LOGO, DDPGDemo, TD3Demo
from sb3_actpc.demonstrations import Demonstrations
from tests.recordings import record

SMALL: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 1000, "buffer_size": 200, "seed": 0}


class Corridor(gym.Env[np.ndarray, np.ndarray]):
    """Observes (episode, step); the k-th episode has 5 + k steps, and only its last one has a reward, 1."""

    observation_space = gym.spaces.Box(-1000, 1000, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    episode = -1
    place = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.episode += 1
        self.place = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.place += 1
        is_over = self.place == 5 + self.episode
        return self._observation(), float(is_over), is_over, False, {}

    def _observation(self) -> np.ndarray:
        return np.array([self.episode, self.place], dtype=np.float32)


class StopAfter(BaseCallback):
    """Stops, or interrupts, after so many steps of one ``learn``."""

    def __init__(self, n_steps: int, interrupts: bool = False) -> None:
        super().__init__()
        self.n_left = n_steps
        self.interrupts = interrupts

    def _on_step(self) -> bool:
        self.n_left -= 1
        if self.n_left == 0 and self.interrupts:
            raise KeyboardInterrupt
        return self.n_left > 0


def stored(model: TD3Demo) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Observations, next observations, rewards and dones, in the order of their collection."""
    buffer = model.replay_buffer
    rows = slice(0, buffer.pos)
    return buffer.observations[rows, 0], buffer.next_observations[rows, 0], buffer.rewards[rows, 0], buffer.dones[rows, 0]


@pytest.mark.parametrize("train_freq", [1, 4, (1, "episode")])
def test_a_callback_that_stops_at_an_episodes_end_loses_nothing(train_freq: Any) -> None:
    model = TD3Demo("MlpPolicy", Corridor(), train_freq=train_freq, **SMALL)
    for _ in range(6):
        model.learn(100, callback=StopTrainingOnMaxEpisodes(1), reset_num_timesteps=False)
    observations, following, rewards, dones = stored(model)
    n_steps = 5 + 6 + 7 + 8 + 9 + 10
    assert len(rewards) == model.num_timesteps == n_steps
    assert (rewards.sum(), dones.sum()) == (6, 6)
    assert model._episode_num == len(model.ep_info_buffer) == 6
    assert (following[:, 1] == observations[:, 1] + 1).all() and (following[:, 0] == observations[:, 0]).all()


def test_a_callback_that_stops_anywhere_loses_nothing() -> None:
    model = TD3Demo("MlpPolicy", Corridor(), train_freq=4, **SMALL)
    for n_steps in (3, 1, 5, 2):
        model.learn(100, callback=StopAfter(n_steps), reset_num_timesteps=False)
    observations, following, _, _ = stored(model)
    assert len(observations) == 11
    np.testing.assert_array_equal(following[:, 1], observations[:, 1] + 1)
    assert observations[:, 1].tolist() == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("reset_num_timesteps", [True, False])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_no_return_is_of_two_episodes_after_an_interruption(n_steps: int, reset_num_timesteps: bool) -> None:
    model = TD3Demo("MlpPolicy", Corridor(), n_steps=n_steps, **SMALL)
    with pytest.raises(KeyboardInterrupt):
        model.learn(100, callback=StopAfter(3, interrupts=True))
    model.learn(6, reset_num_timesteps=reset_num_timesteps)
    observations, following, _, _ = stored(model)
    assert (following[:, 0] == observations[:, 0]).all() and (following[:, 1] == observations[:, 1] + 1).all()
    batch = model.replay_buffer.sample(200)
    assert (batch.observations[:, 0] == batch.next_observations[:, 0]).all()
    assert (batch.next_observations[:, 1] - batch.observations[:, 1]).max() <= n_steps


class WithActions(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Pendulum with another action space."""

    def __init__(self, space: gym.spaces.Box) -> None:
        super().__init__(gym.make("Pendulum-v1"))
        self.action_space = space


@pytest.mark.parametrize("kind", [TD3Demo, DDPGDemo, BC, LOGO])
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


@pytest.mark.parametrize(("kind", "more"), [(TD3Demo, {"n_steps": 3}), (DDPGDemo, {}), (BC, {}), (LOGO, {})])
def test_the_callers_dictionaries_stay_as_they_were(kind: type, more: dict[str, Any]) -> None:
    given: dict[str, Any] = {"policy_kwargs": {"net_arch": [8], "optimizer_kwargs": {"weight_decay": 0.1}}, **more}
    if kind in (TD3Demo, DDPGDemo):
        given["replay_buffer_kwargs"] = {}
    before = deepcopy(given)
    kind("MlpPolicy", "Pendulum-v1", demonstrations=record("Pendulum-v1"), **given)
    assert given == before
