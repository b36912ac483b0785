"""Observations that float32 cannot follow are named while the agent collects them."""

import itertools
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_actpc import ActPC
from sb3_actpc.baselines.td3 import TD3Demo


class Clock(gym.Env):
    """Observes a number that changes at random, and a clock that starts at ``start``."""

    def __init__(self, start: float = 1.7e9, is_dict: bool = False, declared: type = np.float64) -> None:
        box = spaces.Box(-np.inf, np.inf, (1,), declared)
        self.observation_space = spaces.Dict({"speed": box, "clock": box})
        if not is_dict:
            self.observation_space = spaces.Box(-np.inf, np.inf, (2,), declared)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.start, self.is_dict = start, is_dict

    def _observe(self):
        speed = self.np_random.normal()
        if self.is_dict:
            return {"speed": np.array([speed]), "clock": np.array([self.start + self.t])}
        return np.array([speed, self.start + self.t])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._observe(), {}

    def step(self, action):
        self.t += 1
        return self._observe(), 0.0, False, self.t == 30, {}


def learn(algorithm, env, n_steps: int = 250) -> None:
    policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
    algorithm(policy, env, learning_starts=1000, buffer_size=200, policy_kwargs={"net_arch": [8]}).learn(n_steps)


@pytest.mark.parametrize(
    ("vec", "algorithm", "is_dict", "declared"),
    [
        *itertools.product([DummyVecEnv], [ActPC, TD3Demo], [False, True], [np.float64, np.float32]),
        (SubprocVecEnv, ActPC, True, np.float64),
        (SubprocVecEnv, TD3Demo, False, np.float32),
    ],
)
def test_a_timestamp_is_named(algorithm, is_dict, declared, vec):
    quick = {"start_method": "fork"} if vec is SubprocVecEnv else {}
    env = vec([lambda: Monitor(Clock(is_dict=is_dict, declared=declared))] * 2, **quick)
    name = r"clock\[0\]" if is_dict else "column 1"
    with pytest.warns(UserWarning, match=f"successive values of {name}: let the environment subtract an offset"):
        learn(algorithm, env)
    env.close()


@pytest.mark.parametrize("declared", [np.float64, np.float32])
def test_normalization_helps_where_it_is_given_the_whole_precision(declared):
    env = VecNormalize(DummyVecEnv([lambda: Clock(declared=declared)]))
    if declared is np.float32:  # the clock has been rounded before it arrives there
        with pytest.warns(UserWarning, match="column 1"):
            learn(TD3Demo, env)
        return
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        learn(TD3Demo, env)


@pytest.mark.parametrize("start", [0.0, 1e3])
def test_a_clock_that_float32_follows_is_not_named(start):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        learn(ActPC, DummyVecEnv([lambda: Clock(start)]))


def test_it_is_said_once():
    env = DummyVecEnv([Clock])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        learn(TD3Demo, env, 600)
    assert len([one for one in caught if "float32" in str(one.message)]) == 1
