"""RLPD on SBX's SAC: half of every batch demonstrated, normalized observations, layer-normalized critics."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sbx", reason="sbx is an extra")

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_actpc.baselines import RLPD
from tests.recordings import record

ENV = "Pendulum-v1"
SMALL = {"learning_starts": 10, "batch_size": 16, "gradient_steps": 2, "buffer_size": 500, "seed": 1}


def make(**options: object) -> RLPD:
    options = {"demonstrations": record(ENV), "policy_kwargs": {"net_arch": [8], "n_critics": 3}, **SMALL, **options}
    return RLPD("MlpPolicy", ENV, **options)


def weights(tree: object) -> list[np.ndarray]:
    if hasattr(tree, "items"):
        return [array for _, part in sorted(tree.items()) for array in weights(part)]
    return [np.array(tree)]


@pytest.mark.parametrize("n_steps", [1, 3])
def test_every_critic_learns_and_the_actor_does(n_steps: int) -> None:
    model = make(n_steps=n_steps)
    critics, actor = weights(model.policy.qf_state.params), weights(model.policy.actor_state.params)
    model.learn(30)
    for before, after in zip(critics, weights(model.policy.qf_state.params), strict=True):
        assert np.isfinite(after).all()
        assert all((before[critic] != after[critic]).any() for critic in range(3))
    assert any((before != after).any() for before, after in zip(actor, weights(model.policy.actor_state.params), strict=True))


def test_critics_are_layer_normalized() -> None:
    assert "LayerNorm" in str(make().policy.qf_state.params)


def test_there_is_one_actor_update_for_the_updates_of_one_step() -> None:
    model = make(gradient_steps=5)
    model.learn(14)
    assert int(model.policy.qf_state.step) == 20
    assert int(model.policy.actor_state.step) == 4


def test_actions_are_chosen_from_observations_in_units_of_the_demonstrations() -> None:
    model = make()
    shown = record(ENV).observations
    rows, _ = model.policy.prepare_obs(shown)
    np.testing.assert_allclose(rows.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(rows.std(axis=0), 1, atol=1e-4)


def test_a_small_entry_is_normalized_and_a_constant_one_is_not() -> None:
    policy = make().policy
    rows = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32) * [1.0, 1e-3, 0.0] + 2.0
    policy.fit_normalization(rows)
    np.testing.assert_allclose(policy.normalized(rows).std(axis=0), [1.0, 1.0, 0.0], atol=2e-3)
    np.testing.assert_allclose(policy.normalized(rows[:1] + 0.5)[0, 2], 0.5, atol=1e-4)


@pytest.mark.parametrize(("given", "held"), [("auto", -2.0), ("half", -1.0), (-3.0, -3.0)])
def test_the_entropy_is_held_at_a_share_of_the_number_of_action_dimensions(given: str | float, held: float) -> None:
    task = "SparseReacher-v5"  # two dimensions
    assert RLPD("MlpPolicy", task, policy_kwargs={"net_arch": [8]}, target_entropy=given, **SMALL).target_entropy == held


def test_another_target_entropy_is_refused() -> None:
    with pytest.raises(ValueError, match="target_entropy='Half' must be 'auto', 'half' or a number"):
        make(target_entropy="Half")


def test_without_demonstrations_observations_stay_as_they_are() -> None:
    rows = np.array([[50.0, -2.0, 100.0]], dtype=np.float32)
    np.testing.assert_array_equal(make(demonstrations=None).policy.prepare_obs(rows)[0], rows)


def test_observations_are_normalized_once() -> None:
    env = VecNormalize(make_vec_env(ENV))
    model = RLPD("MlpPolicy", env, demonstrations=record(ENV), policy_kwargs={"net_arch": [8]}, **SMALL)
    rows = np.array([[0.5, -2.0, 1.0]], dtype=np.float32)  # VecNormalize's
    np.testing.assert_array_equal(model.policy.prepare_obs(rows)[0], rows)
    model.learn(12)


def test_it_plays_the_same_after_loading_and_goes_on_learning(tmp_path: Path) -> None:
    model = make(n_steps=3).learn(15)
    model.save(tmp_path / "model.zip")
    rows = record(ENV).observations[:4]
    loaded = RLPD.load(tmp_path / "model.zip", env=gym.make(ENV), demonstrations=record(ENV))
    np.testing.assert_array_equal(model.predict(rows, deterministic=True)[0], loaded.predict(rows, deterministic=True)[0])
    played = RLPD.load(tmp_path / "model.zip", demonstrations=None)
    np.testing.assert_array_equal(model.predict(rows, deterministic=True)[0], played.predict(rows, deterministic=True)[0])
    loaded.learn(15, reset_num_timesteps=False)
    assert loaded.num_timesteps == 30


def test_goal_tasks_have_demonstrations_too() -> None:
    demonstrations = record("SparseReacher-v5")
    model = RLPD("MultiInputPolicy", "GoalReacher-v5", demonstrations=demonstrations, policy_kwargs={"net_arch": [8]}, **SMALL)
    model.learn(12)
    assert int(model.policy.qf_state.step) == 4


def with_hindsight(**options: object) -> RLPD:
    given = {**SMALL, "policy_kwargs": {"net_arch": [8]}, "demonstrations": record("SparseReacher-v5"), "hindsight": True}
    return RLPD("MultiInputPolicy", "GoalReacher-v5", **{**given, **options})


@pytest.mark.parametrize("fraction", [0.0, 1.0])
def test_hindsight_relabels_the_goals_of_agent_and_demonstrations(fraction: float) -> None:
    model = with_hindsight(demonstration_fraction=fraction).learn(60)
    batch = model.replay_buffer.sample(200)
    achieved, wanted = batch.next_observations["achieved_goal"], batch.next_observations["desired_goal"]
    assert 0.05 < np.isclose(achieved, wanted).all(axis=1).mean()  # without it no goal is hit exactly


def test_hindsight_waits_for_the_end_of_an_episode(tmp_path: Path) -> None:
    model = with_hindsight(learning_starts=10, replay_buffer_kwargs={"n_sampled_goal": 8})
    assert int(model.learn(48).policy.qf_state.step) == 0
    assert int(model.learn(8, reset_num_timesteps=False).policy.qf_state.step) > 0
    model.save(tmp_path / "model.zip")
    loaded = RLPD.load(tmp_path / "model.zip", env=gym.make("GoalReacher-v5"), demonstrations=record("SparseReacher-v5"))
    assert loaded.learn(8, reset_num_timesteps=False).replay_buffer.n_sampled_goal == 8


def test_hindsight_needs_goals() -> None:
    with pytest.raises(ValueError, match="RLPD: hindsight needs a goal task"):
        make(hindsight=True)
