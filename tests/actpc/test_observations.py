"""Observations as circuits see them: units, bounds, VecNormalize and the demonstrations."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_actpc import ActPC
from sb3_actpc.utils.normalization import ObservationNormalizer
from tests.actpc.agents import QUICK, imitating, make
from tests.actpc.envs import CountingEnv, demonstrations


@pytest.mark.parametrize("unit", [1e-5, 1.0, 1e5])
def test_features_are_normalised_in_any_unit(unit):
    normalizer, features = ObservationNormalizer(2), th.randn(200, 2) * th.tensor([1.0, 3.0]) + 2.0
    normalizer.fit(unit * features)
    assert th.allclose(normalizer(unit * features).std(0, correction=0), th.ones(2), atol=1e-3)


@pytest.mark.parametrize("value", [1234.567, 101325.3, 0.1])
def test_a_large_constant_has_not_changed(value):
    """Its mean, in float32, is another number, so that all rows deviate from it."""
    normalizer = ObservationNormalizer(1)
    normalizer.fit(th.full((6000, 1), value))
    assert normalizer.scale.item() == 1.0 and normalizer.mean.item() == pytest.approx(value, rel=1e-6)


def test_numerical_noise_is_no_change():
    normalizer = ObservationNormalizer(2)
    normalizer.fit(th.stack([1e-12 * th.randn(100), 0.8 + 1e-6 * th.randn(100)], dim=1))
    assert normalizer.scale.tolist() == [1.0, 1.0]


def test_observations_beyond_what_circuits_see_are_the_environments_fault():
    class Far(CountingEnv):
        def __init__(self):
            super().__init__()
            self.observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)

        def _observation(self):
            return np.array([1e200, 0.0, 1.0])

    with pytest.raises(ValueError, match="environment: observations are not finite"):
        make(DummyVecEnv([Far])).learn(5)


@pytest.mark.parametrize("dict_observations", [False, True])
def test_vec_normalize_knows_the_demonstrations_before_they_are_imitated(dict_observations):
    env = VecNormalize(DummyVecEnv([lambda: CountingEnv(dict_observations=dict_observations)]), norm_reward=False)
    data = demonstrations(n_episodes=2, length=700)  # shown in two parts
    if dict_observations:
        twice = [np.concatenate([part, 2 * part], axis=1) for part in (data.observations, data.next_observations)]
        data = type(data)(**{**vars(data), "observations": twice[0], "next_observations": twice[1]})
    model = ActPC("MultiInputPolicy" if dict_observations else "MlpPolicy", env, demonstrations=data, **QUICK)
    with pytest.warns(UserWarning, match="drift"):
        model.learn(1)
    shown = data.observations[:, :3]
    first = env.obs_rms["a"] if dict_observations else env.obs_rms
    assert first.mean == pytest.approx(shown.mean(0), abs=0.02) and first.var == pytest.approx(shown.var(0), rel=0.02)
    if dict_observations:
        assert env.obs_rms["b"].mean == pytest.approx(2 * shown.mean(0), abs=0.02)


def test_statistics_that_are_held_stay():
    env = VecNormalize(DummyVecEnv([CountingEnv]), norm_reward=False, training=False)
    before = env.obs_rms.mean.copy()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "VecNormalize's statistics drift")
        imitating(env).learn(1)
    assert np.array_equal(env.obs_rms.mean, before)
