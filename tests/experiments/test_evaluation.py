"""When a training is evaluated, and what evaluation episodes report."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_actpc.demonstrations.recording import ENDLESS
from sb3_actpc.experiments.runs import Run, play_episodes, train_run


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
