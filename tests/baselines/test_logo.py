"""LOGO: TRPO without demonstrations; with them a second step, within its trust region, towards them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import TRPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_actpc.baselines import LOGO
from sb3_actpc.demonstrations.dataset import Demonstrations
from tests.recordings import record

SMALL = {"n_steps": 64, "batch_size": 32, "n_critic_updates": 2, "seed": 1}
pytestmark = pytest.mark.filterwarnings("ignore:.*recorded behind no wrapper.*")


def weights(model: TRPO) -> th.Tensor:
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


def make(env: Any = "Pendulum-v1", **options: Any) -> LOGO:
    settings = {"demonstrations": record("Pendulum-v1", 4, 16), "discriminator_net_arch": [16], **SMALL, **options}
    return LOGO("MlpPolicy", env, **settings)


def pushes() -> Demonstrations:
    """Always with 2, as the untrained policy does not."""
    shown = record("Pendulum-v1", 4, 16)
    return replace(shown, actions=np.full_like(shown.actions, 2.0))


def test_without_demonstrations_it_is_trpo_number_by_number() -> None:
    trpo = TRPO("MlpPolicy", "Pendulum-v1", cg_max_steps=10, line_search_shrinking_factor=0.5, **SMALL).learn(128)
    assert th.equal(weights(trpo), weights(make(demonstrations=None).learn(128)))


def test_the_discriminator_learns_who_acted() -> None:
    model = make(demonstrations=pushes(), discriminator_learning_rate=3e-2, guidance_delta=0.0).learn(64 * 60)
    assert model.logger.name_to_value["train/discriminator_accuracy"] > 0.9
    seen, theirs = model.discriminator(th.tensor([[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 2.0]])).flatten()
    assert seen > theirs  # -log D: worth more where it takes the agent for the demonstrators


def test_the_discriminator_sees_demonstrations_normalised_as_the_agents_observations() -> None:
    """As if environment and demonstrations were normalised: it could else tell them by their scale."""
    mean, spread = np.array([0.5, -0.2, 1.0]), np.array([2.0, 0.5, 3.0])
    normalize = VecNormalize(make_vec_env("Pendulum-v1", seed=1), training=False, norm_reward=False, epsilon=0.0)
    normalize.obs_rms.mean, normalize.obs_rms.var = mean, spread**2

    def scaled(rows: np.ndarray) -> np.ndarray:
        return ((rows - mean) / spread).astype(np.float32)

    def make_scaled() -> gym.Env:
        space = gym.spaces.Box(-100, 100, (3,), np.float32)
        return gym.wrappers.TransformObservation(gym.make("Pendulum-v1"), scaled, space)

    shown = record("Pendulum-v1", 4, 16)
    rows = {name: scaled(getattr(shown, name)) for name in ("observations", "next_observations")}
    both = replace(shown, **rows, metadata={**shown.metadata, "wrappers": ["TransformObservation"]})
    one, other = make(normalize).learn(64), make(make_vec_env(make_scaled, seed=1), demonstrations=both).learn(64)
    for mine, theirs in zip(one.discriminator.parameters(), other.discriminator.parameters(), strict=True):
        th.testing.assert_close(mine, theirs, atol=1e-4, rtol=1e-3)


def test_guidance_moves_the_policy_towards_the_demonstrated_actions_within_its_trust_region() -> None:
    """TRPO's own step is made tiny, so that guidance alone moves the policy."""
    shown = pushes()
    options = {"n_steps": 128, "target_kl": 1e-9, "guidance_delta": 0.05, "discriminator_learning_rate": 1e-2}
    model = make(make_vec_env("Pendulum-v1", n_envs=2, seed=5), demonstrations=shown, **options)
    before, _ = model.predict(shown.observations, deterministic=True)
    sizes = []
    for _ in range(20):
        model.learn(256, reset_num_timesteps=False)
        logged = model.logger.name_to_value
        sizes.append(logged["train/guidance_kl_divergence_loss"])
        assert (sizes[-1] > 0) == logged["train/guidance_is_line_search_success"]
    assert max(sizes) <= 0.05 and np.median(sizes) > 0.005
    assert model.predict(shown.observations, deterministic=True)[0].mean() > before.mean() + 0.3
    assert model.target_kl == 1e-9 and logged["train/n_updates"] == 20  # guidance is no iteration of TRPO's


class Counts(gym.Wrapper):
    """Pays one more, or one less, in each episode."""

    def __init__(self, change: float) -> None:
        super().__init__(gym.make("Pendulum-v1", max_episode_steps=8))
        self.change = change
        self.paid = 0.0

    def reset(self, **options: Any) -> Any:
        self.paid += self.change
        return super().reset(**options)

    def step(self, action: np.ndarray) -> Any:
        observation, _, *rest = super().step(action)
        return observation, self.paid, *rest


@pytest.mark.parametrize(("change", "expected"), [(1.0, [0.1, 0.1, 0.1, 0.1, 0.05, 0.03, 0.03]), (-1.0, [0.1] * 7)])
def test_the_trust_region_shrinks_only_after_its_iterations_and_when_the_return_rises(change: float, expected: list) -> None:
    deltas = []

    class Keeps(BaseCallback):
        def _on_rollout_start(self) -> None:
            deltas.append(self.model.delta)

        def _on_step(self) -> bool:
            return True

    settings = {"guidance_delta": 0.1, "guidance_iterations": 3, "guidance_decay": 0.5, "guidance_delta_min": 0.03}
    make(Counts(change), **settings).learn(64 * 7, callback=Keeps())
    assert deltas == pytest.approx(expected)


def test_a_vanished_trust_region_leaves_trpo_alone() -> None:
    logged = make(guidance_delta=5e-7).learn(64).logger.name_to_value
    assert "train/guidance_delta" in logged and "train/guidance_value_loss" not in logged


def test_it_saves_and_goes_on_with_its_discriminator(tmp_path: Path) -> None:
    path = tmp_path / "shown.npz"
    record("Pendulum-v1", 4, 16).save(path)
    model = make(demonstrations=path).learn(128)
    model.save(tmp_path / "model.zip")
    path.rename(tmp_path / "moved.npz")
    loaded = LOGO.load(tmp_path / "model.zip")  # played without demonstrations
    observation = model.env.reset()
    assert np.array_equal(*(agent.predict(observation, deterministic=True)[0] for agent in (model, loaded)))
    for name in ("discriminator", "guidance_policy"):
        for mine, theirs in zip(getattr(model, name).parameters(), getattr(loaded, name).parameters(), strict=True):
            assert th.equal(mine, theirs)
    (tmp_path / "moved.npz").rename(path)
    loaded.set_env(model.env)
    before = weights(loaded)
    assert not th.equal(before, weights(loaded.learn(64)))


def test_it_is_played_without_its_demonstrations(tmp_path: Path) -> None:
    model, rows = make().learn(64), record("Pendulum-v1").observations[:4]
    model.save(tmp_path / "model.zip")
    played = LOGO.load(tmp_path / "model.zip", demonstrations=None)
    assert np.array_equal(*(one.predict(rows, deterministic=True)[0] for one in (model, played)))


def test_bad_settings_and_spaces_that_the_discriminator_cannot_take_are_refused() -> None:
    with pytest.raises(ValueError, match=r"guidance_decay=2\.0 must be between 0 and 1"):
        make(guidance_decay=2.0)
    with pytest.raises(ValueError, match="LOGO's discriminator needs Box spaces"):
        make("CartPole-v1")


def test_without_returns_of_episodes_it_says_what_is_missing() -> None:
    env = DummyVecEnv([lambda: gym.make("Pendulum-v1", max_episode_steps=16)])
    with pytest.raises(ValueError, match=r"make SB3's Monitor .* the outermost wrapper"):
        make(env).learn(64)
    assert LOGO("MlpPolicy", env, **SMALL).learn(64).num_timesteps == 64
