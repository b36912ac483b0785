"""A task whose returns are known by hand, and the command that trains SB3's TD3 on it."""

import csv
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_actpc.cli import main

EPISODE_LENGTH = 10
ENV_ID = "SparseLine-v0"
TRAIN = ["train", "--env", ENV_ID, "--algo", "td3", "--preset", "small.yml"]
PLAIN = [*TRAIN, "--demonstrations", "none"]
RESULTS = {"dense_return": 20.0, "dense_return_std": 0.0, "return": 10.0, "return_std": 0.0}
RESULTS |= {"success": 1.0, "episode_length": 10.0}


class LineEnv(gym.Env[np.ndarray, np.ndarray]):
    """Ten steps; each is paid 2 densely and 1 sparsely, whatever the action. ``gain`` multiplies the dense reward.

    The observation is (the number drawn at reset, the step).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, gain: float = 1.0, render_mode: str | None = None) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.gain = gain
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.drawn, self.n_steps = self.np_random.uniform(), 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.n_steps += 1
        info = {"dense_reward": 2.0 * self.gain, "is_success": self.n_steps == EPISODE_LENGTH}
        return self._observation(), 1.0, self.n_steps == EPISODE_LENGTH, False, info

    def render(self) -> Any:
        return np.full((32, 48, 3), 20 * self.n_steps, dtype=np.uint8)

    def _observation(self) -> np.ndarray:
        return np.array([self.drawn, self.n_steps], dtype=np.float32)


def train(*arguments: str) -> int:
    """``sb3-actpc train`` with TD3 on the line, without demonstrations."""
    return main([*PLAIN, "--no-progress", *arguments])


def rows_of(folder: str | Path) -> list[dict[str, str]]:
    with open(Path(folder) / "progress.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


RUN = Path("runs") / ENV_ID / "td3_small_seed0"
