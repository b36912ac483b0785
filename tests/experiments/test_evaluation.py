"""When a training is evaluated, and what evaluation episodes report."""

import dataclasses
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_actpc import shipped_demonstrations
from sb3_actpc.demonstrations import Demonstrations
from sb3_actpc.demonstrations.recording import ENDLESS
from sb3_actpc.experiments.runs import Run, play_episodes, train_run
from sb3_actpc.experiments.runs.evaluation import EVALUATION_SEED_OFFSET


class Silent(gym.Wrapper):
    """Reports success, of every second episode, and never a failure."""

    episode = 0

    def reset(self, **options: Any) -> Any:
        self.episode += 1
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        *values, info = super().step(action)
        return *values, {"is_success": True} if self.episode % 2 else info


class Resting:
    def predict(self, observation: np.ndarray, *further: Any, **options: Any) -> tuple[np.ndarray, None]:
        return np.zeros((len(observation), 1), np.float32), None


def test_an_episode_that_reports_no_success_beside_others_that_do_has_failed() -> None:
    env = gym.make("Pendulum-v1", max_episode_steps=3)
    assert play_episodes(Resting(), [Silent(env)], 4, seed=0).summary()["success"] == 0.5
    assert play_episodes(Resting(), [env], 2, seed=0).summary()["success"] is None


def test_evaluations_stay_at_multiples_of_their_interval_with_several_environments(tmp_path: Path) -> None:
    settings = {"learning_starts": 200, "policy_kwargs": {"net_arch": [8]}}
    run = Run(env="Pendulum-v1", algo="td3", n_timesteps=102, n_envs=3, eval_freq=20, eval_episodes=1, settings=settings)
    train_run(run.model_copy(update={"output": str(tmp_path / "run"), "progress": False}))
    rows = np.genfromtxt(tmp_path / "run" / "progress.csv", delimiter=",", names=True)
    assert rows["timesteps"].tolist() == [0, 21, 42, 60, 81, 102]


def test_an_evaluation_without_an_end_says_what_is_missing() -> None:
    env = gym.make("Pendulum-v1", max_episode_steps=ENDLESS + 1)
    with pytest.warns(UserWarning, match=f"evaluation episode has gone on for {ENDLESS} steps: limit it"):
        play_episodes(Resting(), [env], 1, seed=0)


def test_a_policy_is_evaluated_once_until_the_actor_differs_from_it(tmp_path: Path) -> None:
    seeds: list[int] = []

    class Noted(gym.Wrapper):
        """Notes the seeds of evaluation episodes."""

        def reset(self, *, seed: int | None = None, **options: Any) -> Any:
            seeds.extend(() if seed is None or seed < EVALUATION_SEED_OFFSET else (seed,))
            return super().reset(seed=seed, **options)

    gym.register("Noted-v0", lambda: Noted(gym.make("SparseReacher-v5")), max_episode_steps=50)
    try:
        settings = {"policy_kwargs": {"net_arch": [8]}, "guidance_kwargs": {"bc_updates": 5}}
        run = Run(env="Noted-v0", n_timesteps=4, eval_freq=4, eval_episodes=2, settings=settings)
        shown = Demonstrations.load(shipped_demonstrations("SparseReacher-v5"))
        dataclasses.replace(shown, env_id="Noted-v0").save(tmp_path / "shown.npz")
        paths = {"output": str(tmp_path / "run"), "demonstrations": str(tmp_path / "shown.npz")}
        train_run(run.model_copy(update={"progress": False, **paths}))
    finally:
        gym.registry.pop("Noted-v0")
    rows = np.genfromtxt(tmp_path / "run" / "progress.csv", delimiter=",", names=True)
    first = EVALUATION_SEED_OFFSET + run.seed
    assert seeds == [first, first + 1, *[first, first + 1] * 2]  # the same policy after BC, then two
    assert rows["actor_return"][0] == rows["return_"][0] and rows["actor_return"].shape == (2,)
