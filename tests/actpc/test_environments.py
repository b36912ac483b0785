"""Environments in processes, of several kinds and numbers."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_actpc import ActPC
from sb3_actpc.utils.tasks import task_id
from tests.actpc.agents import imitating, make
from tests.actpc.envs import CountingEnv, demonstrations


def made_with_a_function():
    gym.register("Counted-v3", CountingEnv)
    env = gym.make("Counted-v3", returns=(0.0, 1.0), disable_env_checker=True)
    env.spec.kwargs["reward"] = lambda: 0.0  # which no process can send to another
    return env


def test_environments_in_processes_need_not_send_what_they_were_made_with():
    env = SubprocVecEnv([made_with_a_function] * 2, start_method="fork")
    try:
        assert task_id(env) == "Counted-v3"
        imitating(env, demonstrations=demonstrations(env_id="Counted-v2")).learn(4)
        with pytest.raises(ValueError, match=r"dataclasses.replace\(demonstrations, env_id='Counted-v3'\)"):
            imitating(env, demonstrations=demonstrations(env_id="Other-v0"))
    finally:
        env.close()


def test_the_task_of_an_environment():
    assert task_id(DummyVecEnv([made_with_a_function])) == "Counted-v3"
    assert task_id(DummyVecEnv([lambda: TimeLimit(CountingEnv(), 5)])) is None
    in_process = SubprocVecEnv([lambda: TimeLimit(CountingEnv(), 5)], start_method="fork")
    try:
        assert task_id(in_process) is None
    finally:
        in_process.close()


def test_noise_of_several_environments_is_that_of_one_in_another_number_of_them(tmp_path):
    noise = NormalActionNoise(np.zeros(2), np.ones(2))
    make(n_envs=2, action_noise=noise).learn(20).save(tmp_path / "agent")
    for n_envs in (1, 3):
        loaded = ActPC.load(tmp_path / "agent", env=DummyVecEnv([CountingEnv] * n_envs)).learn(30)
        assert loaded.num_timesteps == 30 and getattr(loaded.action_noise, "n_envs", 1) == n_envs


class WholeNumbers(CountingEnv):
    def __init__(self):
        super().__init__()
        self.observation_space = gym.spaces.Box(0, 255, (2,), np.int32)

    def _observation(self):
        return np.full(2, 10 * self.count, np.int32)


def test_last_observations_of_whole_numbers_are_stored_as_they_were():
    """SB3 rounds them: it writes the normalized ones among whole numbers."""
    model = make(VecNormalize(DummyVecEnv([WholeNumbers]))).learn(20)
    buffer = model.replay_buffer
    assert buffer.dones[:20].sum() >= 2
    np.testing.assert_array_equal(buffer.next_observations[:20] - buffer.observations[:20], 10)


class Info(dict):
    """Its keys are attributes too."""

    def __getattr__(self, name):
        if name not in self:
            raise AttributeError(name)
        return self[name]


class Attributes(CountingEnv):
    def step(self, action):
        *result, info = super().step(action)
        return *result, Info(info, energy=1.0)


class Costly(gym.Wrapper):
    def step(self, action):
        observation, reward, *ends, info = self.env.step(action)
        return observation, reward - info.energy, *ends, info


def test_infos_of_a_class_of_their_own_stay_such():
    assert make(DummyVecEnv([lambda: Costly(Attributes())])).learn(20).num_timesteps == 20
