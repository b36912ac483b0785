"""A rollout that is stopped in the middle: every environment step is stored, with its reward and its end."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_actpc import ActPC
from tests.actpc.agents import make


class LastStepRewarded(gym.Env):
    """Episodes of seven or eight steps in turn; reward 1 at the last step alone. Observes the step."""

    def __init__(self, is_truncated: bool = False, keys: bool = False) -> None:
        box = spaces.Box(-1.0, 10.0, (1,), np.float32)
        self.observation_space = spaces.Dict({"step": box}) if keys else box
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.is_truncated, self.keys = is_truncated, keys
        self.episode = 0

    def _observe(self):
        observed = np.array([self.t], np.float32)
        return {"step": observed} if self.keys else observed

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode += 1
        self.t = 0
        return self._observe(), {}

    def step(self, action):
        self.t += 1
        ends = self.t == 7 + self.episode % 2
        return self._observe(), float(ends), ends and not self.is_truncated, ends and self.is_truncated, {}


@pytest.mark.parametrize("is_truncated", [False, True])
@pytest.mark.parametrize("keys", [False, True])
@pytest.mark.parametrize("normalizes", [False, True])
def test_a_callback_that_stops_at_the_end_of_an_episode_loses_nothing(is_truncated, keys, normalizes):
    """The example of SB3 issue 2056: one ``learn`` per episode."""
    env = DummyVecEnv([lambda: LastStepRewarded(is_truncated, keys)])
    if normalizes:
        env = VecNormalize(env)
    model = ActPC("MultiInputPolicy" if keys else "MlpPolicy", env, learning_starts=5, batch_size=8, seed=0)
    for _ in range(6):
        model.learn(1000, callback=StopTrainingOnMaxEpisodes(1), reset_num_timesteps=False)
    buffer = model.replay_buffer
    n_steps = model.num_timesteps
    assert n_steps == sum(7 + episode % 2 for episode in range(1, 7))
    assert buffer.pos == n_steps
    assert buffer.rewards[:n_steps].sum() == 6.0
    assert buffer.dones[:n_steps].sum() == 6.0
    assert buffer.timeouts[:n_steps].sum() == 6.0 * is_truncated
    assert len(buffer.self_imitation.lengths) == 6
    observed = (buffer.observations["step"] if keys else buffer.observations)[:n_steps].ravel()
    followed = (buffer.next_observations["step"] if keys else buffer.next_observations)[:n_steps].ravel()
    assert np.array_equal(followed, observed + 1.0)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("train_freq", [1, 4, (1, "episode")])
def test_ctrl_c_in_a_callback_stores_the_step_that_was_made(n_envs, train_freq):
    class Interrupts(BaseCallback):
        def _on_step(self):
            if self.n_calls == 10:
                raise KeyboardInterrupt
            return True

    if n_envs > 1 and isinstance(train_freq, tuple):
        pytest.skip("episodes of several environments do not end together")
    model = make(DummyVecEnv([LastStepRewarded] * n_envs), learning_starts=0, train_freq=train_freq)
    with pytest.raises(KeyboardInterrupt):
        model.learn(1000, callback=Interrupts())
    assert model.replay_buffer.pos == 10
    assert model.num_timesteps == 10 * n_envs
    model.learn(30 * n_envs, reset_num_timesteps=False)
    buffer = model.replay_buffer
    rows = buffer.observations[: buffer.pos, :, 0], buffer.next_observations[: buffer.pos, :, 0]
    assert np.array_equal(rows[1], rows[0] + 1.0)
