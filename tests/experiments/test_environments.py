"""Every algorithm learns in, and is evaluated on, the same environment: same seeds, states, rewards, ends, demonstrations."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from sb3_actpc.experiments.runs import Run, play_episodes, resolve, train_run
from sb3_actpc.experiments.runs.environments import make_env, make_train_env
from sb3_actpc.experiments.runs.evaluation import NormalizedPredictor
from sb3_actpc.experiments.runs.run import build_model
from tests.cli.line import LineEnv
from tests.recordings import record_file

OFF_POLICY = ("actpc", "td3", "ddpg")
ENV_ID = "SparseHopper-v5"


class Recorder(BaseCallback):
    """What the environments showed and paid."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[Any, ...]] = []

    def _on_step(self) -> bool:
        names = ("new_obs", "rewards", "dones", "actions")
        self.rows.append(tuple(np.array(self.locals[name]) for name in names))
        return True


def prepare(algo: str, folder: Path, **more: Any) -> tuple[Any, Any]:
    """An agent that only acts at random, with its environment."""
    settings = {"learning_starts": 10_000, "buffer_size": 1000, "noise_type": None, **more}
    run = Run(env=ENV_ID, algo=algo, n_envs=2, seed=3, demonstrations=str(record_file(folder, ENV_ID)), settings=settings)
    run = resolve(run)
    env = make_train_env(ENV_ID, run.env_kwargs, run.n_envs, run.seed, run.normalize)
    return build_model(run, env), env


def test_algorithms_with_one_seed_see_the_same_states_rewards_and_ends(tmp_path: Path) -> None:
    """While all act at random, by the same seed: 60 steps of two hoppers, several falls."""
    seen = []
    for algo in OFF_POLICY:
        quick = {"guidance_kwargs": {"bc_updates": 1}, "action_noise": 0.0}
        model, env = prepare(algo, tmp_path, **(quick if algo == "actpc" else {}))
        recorder = Recorder()
        model.learn(120, callback=recorder)
        seen.append(recorder.rows)
        env.close()
    assert sum(row[2].sum() for row in seen[0]) >= 2
    for rows in seen[1:]:
        for mine, theirs in zip(seen[0], rows, strict=True):
            assert all(np.array_equal(*pair) for pair in zip(mine, theirs, strict=True))


def test_algorithms_are_given_the_same_demonstrations(tmp_path: Path) -> None:
    reference, env = prepare("actpc", tmp_path)
    expected = reference.expert.episodes
    env.close()
    for algo in ("td3", "ddpg"):
        model, env = prepare(algo, tmp_path)
        shown = model.replay_buffer.demonstrated
        assert shown.observations[:, 0] == pytest.approx(expected.observations, abs=1e-6)
        assert np.array_equal(shown.actions[:, 0], expected.actions)
        assert np.array_equal(shown.rewards[:, 0], reference.expert.demonstrations.rewards)
        env.close()


class LoggedEnv(LineEnv):
    """Remembers what it was reset with and what it then drew."""

    log: list[tuple[int | None, float]] = []  # noqa: RUF012

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = super().reset(seed=seed)
        LoggedEnv.log.append((seed, self.drawn))
        return observation, info


def test_algorithms_are_evaluated_on_the_same_episodes_at_the_same_steps(tmp_path: Path) -> None:
    if "Logged-v0" not in gym.registry:
        gym.register("Logged-v0", entry_point=f"{__name__}:LoggedEnv")
    fewer = {"learning_starts": 10, "batch_size": 4, "policy_kwargs": {"net_arch": [4]}}
    on_policy = {"n_steps": 16, "batch_size": 4, "policy_kwargs": {"net_arch": [4]}}
    logs = {}
    for algo, settings in (("td3", fewer), ("actpc", fewer), ("logo", on_policy)):
        LoggedEnv.log = []
        options = {"eval_freq": 16, "eval_episodes": 3, "progress": False, "output": str(tmp_path / algo)}
        train_run(Run(env="Logged-v0", algo=algo, n_timesteps=32, settings=settings, checkpoint_freq=0, **options))
        logs[algo] = LoggedEnv.log
        rows = (tmp_path / algo / "progress.csv").read_text(encoding="utf-8").splitlines()
        assert [row.split(",")[0] for row in rows[1:]] == ["0", "16", "32"]
    evaluated = [row for row in logs["td3"] if (row[0] or 0) >= 1_000_000]
    assert len(evaluated) == 9
    for log in logs.values():
        assert log == logs["td3"]


def test_a_policy_on_normalised_observations_is_evaluated_and_replayed_on_them(tmp_path: Path) -> None:
    """PPO learns from normalised observations; the environments of the evaluation do not normalise."""
    settings = {"n_steps": 64, "batch_size": 32, "n_epochs": 1}
    run = resolve(Run(env="Pendulum-v1", algo="ppo", settings=settings))
    assert run.normalize == {"gamma": 0.99}
    env = make_train_env("Pendulum-v1", {}, 1, 0, run.normalize)
    assert isinstance(env, VecNormalize)
    model = build_model(run, env)
    model.learn(128)
    env.training = False
    observation = np.array([[0.5, -0.5, 3.0]], dtype=np.float32)
    expected = model.predict(env.normalize_obs(observation), deterministic=True)[0]
    assert not np.array_equal(expected, model.predict(observation, deterministic=True)[0])
    assert np.array_equal(NormalizedPredictor.wrap(model).predict(observation, deterministic=True)[0], expected)
    NormalizedPredictor.save(model, tmp_path)
    saved = NormalizedPredictor.wrap_saved(model, tmp_path)
    assert saved.predict(observation, deterministic=True)[0] == pytest.approx(expected, abs=1e-6)
    bare = [make_env("Pendulum-v1", {})]
    live, replayed = (play_episodes(one, bare, 1, seed=0) for one in (NormalizedPredictor.wrap(model), saved))
    assert live.dense_returns == pytest.approx(replayed.dense_returns, rel=1e-3)


@pytest.mark.parametrize("keys", [None, ["observation"]])
def test_normalised_observations_of_several_parts_are_replayed_too(keys: list[str] | None, tmp_path: Path) -> None:
    settings = {"n_steps": 64, "batch_size": 32, "n_epochs": 1, "normalize": {"norm_obs_keys": keys}}
    run = resolve(Run(env="GoalReacher-v5", algo="ppo", demonstrations="none", settings=settings))
    env: Any = make_train_env(run.env, {}, 1, 0, run.normalize)
    model = build_model(run, env).learn(64)
    NormalizedPredictor.save(model, tmp_path)
    observation = env.get_original_obs()
    expected = model.predict(env.normalize_obs(observation), deterministic=True)[0]
    replayed = NormalizedPredictor.wrap_saved(model, tmp_path).predict(observation, deterministic=True)[0]
    assert np.array_equal(replayed, expected)
    env.close()


def test_what_an_algorithm_or_an_environment_does_not_take_is_said() -> None:
    with pytest.raises(ValueError, match="logo keeps no checkpoints: leave --checkpoint-freq out"):
        resolve(Run(env="Pendulum-v1", algo="logo", checkpoint_freq=10))
    assert resolve(Run(env="Pendulum-v1", algo="logo")).checkpoint_freq == 0
    with pytest.raises(ValueError, match=r"SparseHopper-v5: .*unexpected keyword argument 'treshold'"):
        make_env("SparseHopper-v5", {"treshold": 1.0})
    with pytest.raises(ValueError, match=r"normalize=.*'norm_ob'"):
        make_train_env("Pendulum-v1", {}, 1, 0, {"norm_ob": False})
    with pytest.raises(ValueError, match="PPO takes no action noise"):
        resolve(Run(env="Pendulum-v1", algo="ppo", settings={"noise_type": "normal", "noise_std": 0.1}))
    with pytest.raises(ValueError, match=r"noise_std=0\.1 is of no noise"):
        resolve(Run(env="Pendulum-v1", algo="sac", settings={"noise_std": 0.1}))
