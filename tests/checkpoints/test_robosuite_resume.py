"""Robosuite runs that are stopped in the middle of an episode, and several environments in processes of their own."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_actpc import ActPC
from sb3_actpc.envs import ROBOSUITE_IDS
from sb3_actpc.experiments.runs import Run, train_run
from sb3_actpc.experiments.runs.environments import make_train_env
from tests.checkpoints.runs import SHORT_WARM_UP, assert_same, learn_in_two, learn_straight
from tests.demonstrations.made_up import made_up

pytest.importorskip("robosuite", reason="robosuite is an extra")

SMALL: dict[str, Any] = {
    **SHORT_WARM_UP,
    "policy_kwargs": {"net_arch": [16, 16]},
    "batch_size": 16,
    "prior_updates": 3,
    "learning_starts": 5,
    "gradient_steps": -1,
    "seed": 3,
    "device": "cpu",
}


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_a_run_stopped_within_an_episode_is_the_run_never_stopped(env_id: str, tmp_path: Path) -> None:
    """Episodes of 20 steps, stopped after 33: the arm is on its way, and the next episodes must begin as they would have."""

    def make() -> ActPC:
        env = make_vec_env(env_id, seed=5, env_kwargs={"horizon": 20})
        return ActPC("MlpPolicy", env, demonstrations=made_up(env_id), alpha_ext=1.0, **SMALL)

    straight = learn_straight(make, tmp_path / "straight", 65)
    resumed = learn_in_two(make, tmp_path / "resumed", 65, stop_at=33)
    assert_same(straight, resumed)
    one, other = (model.get_env().envs[0].unwrapped for model in (straight, resumed))  # type: ignore[union-attr]
    np.testing.assert_array_equal(one.data.qpos, other.data.qpos)
    np.testing.assert_array_equal(one.model.geom_size, other.model.geom_size)
    for model in (straight, resumed):
        model.get_env().close()  # type: ignore[union-attr]


def test_several_environments_keep_combined_replay_and_self_imitation() -> None:
    """Two processes: each environment's newest transition is in the batch, each one's success enters the memory."""
    env = make_train_env("SparseLift-v0", {"horizon": 12}, n_envs=2, seed=1)
    assert isinstance(env, SubprocVecEnv)
    model = ActPC("MlpPolicy", env, demonstrations=made_up("SparseLift-v0"), alpha_ext=1.0, **SMALL)
    model.learn(40)
    buffer: Any = model.replay_buffer
    assert (buffer.pos, model._n_updates) == (20, 2 * (20 - 2))  # after 5 transitions, one update per transition
    batch = buffer.sample(8)
    newest = buffer.observations[buffer.pos - 1]
    np.testing.assert_array_equal(np.sort(batch.observations[:2].numpy(), axis=0), np.sort(newest, axis=0))
    env.close()
    buffer.cut_running_episodes()
    observations = model._last_obs
    for step, rewards in enumerate(([0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 1.0])):
        dones = np.array(rewards) > 0
        infos: list[dict[str, Any]] = [{}, {}]
        buffer.add(observations, observations, np.full((2, 7), 0.1 * step), np.array(rewards), dones, infos)
    assert list(buffer.self_imitation.returns) == [1.0, 1.0]
    assert list(buffer.self_imitation.lengths) == [2, 4]


def test_several_mujoco_environments_stay_in_this_process() -> None:
    env = make_train_env("SparseHopper-v5", {}, n_envs=2, seed=1)
    assert not isinstance(env, SubprocVecEnv)
    env.close()


@pytest.mark.parametrize("n_envs", [1, 2])
def test_the_command_trains_with_the_shipped_settings(n_envs: int, tmp_path: Path) -> None:
    """But for sizes: the shipped warm start takes a minute."""
    config = Run(
        env="SparseLift-v0",
        n_timesteps=60,
        n_envs=n_envs,
        eval_episodes=1,
        eval_freq=60,
        env_kwargs={"horizon": 25},
        settings={"guidance_kwargs": {"bc_updates": 5, "critic_warmup": 10}, "prior_updates": 5},
        output=str(tmp_path / "run"),
        progress=False,
    )
    result = train_run(config)
    assert result["timesteps"] == 60
    assert result["success"] in (0.0, 1.0)
    recorded = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (recorded["n_envs"], recorded["settings"]["gradient_steps"]) == (n_envs, -1)
    assert result["versions"]["robosuite"].startswith("1.5")
