"""Tiny environments with known answers, and demonstrations for them."""

import gymnasium as gym
import numpy as np

from sb3_actpc import Demonstrations


class CountingEnv(gym.Env):
    """
    Observation (number of the episode, step in it, ...): every observation is unique. Episodes have the given lengths in
    turn; the sparse return of episode i is ``returns[i]``, paid at its last step, which terminates or is cut.
    """

    def __init__(self, lengths=(5, 9, 3, 12), returns=(0.0, 1.0, 0.0, 2.0), cut=(False, True), dict_observations=False):
        box = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.dict_observations = dict_observations
        self.observation_space = gym.spaces.Dict({"a": box, "b": box}) if dict_observations else box
        self.action_space = gym.spaces.Box(-2.0, 2.0, (2,), np.float32)
        self.lengths, self.returns, self.cut = lengths, returns, cut
        self.episode, self.count = -1, 0

    def _observation(self):
        row = np.array([self.episode / 7, self.count / 11, np.sin(self.episode + 3.0 * self.count)], np.float32)
        return {"a": row, "b": 2 * row} if self.dict_observations else row

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.count = self.episode + 1, 0
        return self._observation(), {}

    def step(self, action):
        self.count += 1
        over = self.count >= self.lengths[self.episode % len(self.lengths)]
        cut = self.cut[self.episode % len(self.cut)]
        reward = self.returns[self.episode % len(self.returns)] if over else 0.0
        return self._observation(), reward, over and not cut, over and cut, {}


def demonstrations(n_episodes: int = 3, length: int = 20, env_id: str = "CountingEnv", seed: int = 0) -> Demonstrations:
    """Made up: random observations, actions that are a function of them, a reward of 1 at each episode's end."""
    rng = np.random.default_rng(seed)
    n = n_episodes * length
    observations = rng.normal(size=(n, 3))
    return Demonstrations(
        observations=observations,
        actions=2 * np.tanh(observations[:, :2] - observations[:, 1:]),
        next_observations=observations + 0.1 * rng.normal(size=(n, 3)),
        rewards=(np.arange(n) % length == length - 1).astype(float),
        terminations=np.zeros(n, dtype=bool),
        episode_starts=np.arange(0, n, length),
        env_id=env_id,
    )
