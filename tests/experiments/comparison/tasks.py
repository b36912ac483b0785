"""A task whose faults are planted, and comparisons of a few steps on it; importable by worker processes."""

import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import yaml

from sb3_actpc.checkpoints import TrainingStopped
from sb3_actpc.experiments.comparison import plan_runs, read_comparison
from sb3_actpc.experiments.comparison.schedule import Outcome, execute_run, run_comparison
from sb3_actpc.experiments.runs import Run, finish_run
from tests.checkpoints.runs import Terminate, log_rows

EPISODE_LENGTH = 8
TASK = f"{__name__}:SparsePoint-v0"
ROOT = Path(__file__).resolve().parents[3]


class PointEnv(gym.Env[np.ndarray, np.ndarray]):
    """A point on a line that the action moves; each step beyond 0.5 is paid 1, densely the position.

    :param fault: a file; while it exists, ``at_fault`` happens at step 30 of the environment's life, and the file is removed
    :param at_fault: ``"error"`` or ``"kill"`` (SIGKILL to this process)
    :param pause: seconds that each step takes
    """

    def __init__(self, fault: str = "", at_fault: str = "kill", pause: float = 0.0) -> None:
        self.observation_space = gym.spaces.Box(-10.0, 10.0, (2,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.fault, self.at_fault, self.pause = fault, at_fault, pause
        self.life, self.count, self.position = 0, 0, 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.count, self.position = 0, float(self.np_random.uniform(-0.3, 0.3))
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.life, self.count = self.life + 1, self.count + 1
        self._be_faulty()
        time.sleep(self.pause)
        self.position += 0.3 * float(action[0])
        is_paid = self.position > 0.5
        info = {"dense_reward": self.position, "is_success": is_paid}
        return self._observation(), float(is_paid), False, self.count == EPISODE_LENGTH, info

    def _be_faulty(self) -> None:
        if self.fault and self.life == 30 and os.path.exists(self.fault):
            os.remove(self.fault)
            if self.at_fault == "error":
                raise RuntimeError("the planted fault")
            os.kill(os.getpid(), signal.SIGKILL)

    def _observation(self) -> np.ndarray:
        return np.array([self.position, self.count / EPISODE_LENGTH], dtype=np.float32)


if "SparsePoint-v0" not in gym.registry:
    gym.register("SparsePoint-v0", entry_point=f"{__name__}:PointEnv")


def write_preset(path: Path = Path("small.yml"), **more: Any) -> None:
    """Settings with which 60 steps take a second."""
    settings = {
        "n_timesteps": 60,
        "settling": "scheduled",
        "learning_starts": 10,
        "batch_size": 8,
        "buffer_size": 200,
        "policy_kwargs": {"net_arch": [8]},
        "noise_type": "normal",
        "noise_std": 0.3,
        "learning_rate": 0.01,
        **more,
    }
    path.write_text(yaml.safe_dump({"default": settings}), encoding="utf-8")


def small_comparison(algos: Sequence[str] = ("first",), seeds: int = 1, **env_kwargs: Any) -> dict[str, Any]:
    """ActPC on the point; a name stands for the small preset with another discount."""
    discounts = {"first": 0.9, "second": 0.8, "third": 0.7}
    entries = [{"name": one, "algo": "actpc", "preset": "small.yml", "settings": {"gamma": discounts[one]}} for one in algos]
    task = {"env": TASK, "env_kwargs": env_kwargs, "demonstrations": "none"}
    return {"envs": [task], "algos": entries, "seeds": seeds, "eval_freq": 20, "eval_episodes": 1, "checkpoint_freq": 10}


def small_runs(folder: Path, algos: Sequence[str] = ("first",), seeds: int = 1, **env_kwargs: Any) -> list[Run]:
    """The table of :func:`small_comparison`."""
    return plan_runs(read_comparison(small_comparison(algos, seeds, **env_kwargs)), folder)


def bring_to_end(runs: Sequence[Run], folder: Path, **options: Any) -> tuple[list[Run], list[str]]:
    """:func:`run_comparison` in this process, one run after the other: those that were begun, and what they said."""
    begun: list[Run] = []
    lines: list[str] = []

    def engine(to_do: Sequence[Run], is_stopped: Callable[[], bool]) -> Iterator[tuple[Run, Outcome]]:
        for run in to_do:
            begun.append(run)
            yield run, execute_run(run, lines.append)

    run_comparison(runs, folder, engine, **options)
    return begun, lines


def interrupt_after(run: Run, n_steps: int) -> None:
    """Execute a run whose process is stopped at a step, after a checkpoint."""
    try:
        finish_run(run, callbacks=[Terminate(n_steps)])
    except TrainingStopped:
        return
    raise AssertionError("it was not stopped")


def measured(run: Run) -> list[Any]:
    """What a run wrote, without times of the clock."""
    return [log_rows(run.folder / name) for name in ("progress.csv", "episodes.csv")]


def straight(algos: Sequence[str] = ("first",)) -> list[Any]:
    """What runs wrote that were never stopped."""
    runs = small_runs(Path("straight"), algos)
    bring_to_end(runs, Path("straight"))
    return [measured(run) for run in runs]
