"""A task whose faults are planted, and comparisons of a few steps on it; importable by worker processes."""

import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import yaml

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.experiments.comparison import plan_runs, read_comparison
from sb3_actpc.experiments.comparison.display import Display
from sb3_actpc.experiments.comparison.execution import Outcome, execute_run
from sb3_actpc.experiments.comparison.schedule import Summary, run_comparison
from sb3_actpc.experiments.runs import Run
from sb3_actpc.experiments.runs.run import CHECKPOINTS

EPISODE_LENGTH = 8
TASK = f"{__name__}:SparsePoint-v0"
ROOT = Path(__file__).resolve().parents[3]


class PointEnv(gym.Env[np.ndarray, np.ndarray]):
    """A point on a line that the action moves; each step beyond 0.5 is paid 1, densely the position.

    :param fault: a file; while it exists, ``at_fault`` happens at step 30 of the environment's life, and the file is removed
    :param at_fault: ``"error"``, ``"kill"`` (SIGKILL to this process) or ``"full"`` (the error of a full disk)
    :param pause: seconds that each step takes
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, fault: str = "", at_fault: str = "kill", pause: float = 0.0, render_mode: str | None = None) -> None:
        self.observation_space = gym.spaces.Box(-10.0, 10.0, (2,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.fault, self.at_fault, self.pause = fault, at_fault, pause
        self.render_mode = render_mode
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
            if self.at_fault == "full":
                raise OSError(28, "No space left on device")
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
        "prior_updates": 3,
        "noise_type": "normal",
        "noise_std": 0.3,
        "learning_rate": 0.01,
        **more,
    }
    path.write_text(yaml.safe_dump({"default": settings}), encoding="utf-8")


def write_demonstrations(path: Path = Path("demonstrations.npz")) -> None:
    """Five episodes of going right at full speed."""
    env = PointEnv()
    rows = []
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        for _ in range(EPISODE_LENGTH):
            following, reward, _, _, info = env.step(np.ones(1))
            rows.append((observation, np.ones(1), following, reward, info["dense_reward"]))
            observation = following
    observations, actions, following, rewards, dense = (np.array(column) for column in zip(*rows, strict=True))
    starts = np.arange(5) * EPISODE_LENGTH
    Demonstrations(
        observations, actions, following, rewards, np.zeros(len(rows)), starts, "SparsePoint-v0", dense_rewards=dense
    ).save(path)


def small_runs(folder: Path, algos: Sequence[Any] = ("first",), seeds: int = 1, **env_kwargs: Any) -> list[Run]:
    """A table of ActPC's runs on the point; a name stands for the small preset with another discount."""
    discounts = {"first": 0.9, "second": 0.8, "third": 0.7}
    entries = [
        {"name": one, "algo": "actpc", "preset": "small.yml", "settings": {"gamma": discounts[one]}}
        if isinstance(one, str)
        else one
        for one in algos
    ]
    task = {"env": TASK, "env_kwargs": env_kwargs, "demonstrations": "none"}
    given = {"envs": [task], "algos": entries, "seeds": seeds, "eval_freq": 20, "eval_episodes": 1, "checkpoint_freq": 10}
    return plan_runs(read_comparison(given), folder)


class InlineEngine:
    """Executes runs in this process, one after the other, and remembers which."""

    def __init__(self) -> None:
        self.begun: list[Run] = []
        self.lines: list[str] = []

    def capacity(self) -> int:
        return 1

    def execute(self, run: Run, stop: threading.Event, on_steps: Callable[[int], None]) -> Outcome:
        self.begun.append(run)
        return self.outcome_of(run)

    def outcome_of(self, run: Run) -> Outcome:
        return execute_run(run, self.lines.append, lambda steps: None)

    def close(self) -> None: ...


class Lines(Display):
    """A display that keeps what it is told."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        super().__init__(bars=False)

    def line(self, text: str) -> None:
        self.lines.append(text)

    def stepped(self, run: Run, steps: int) -> None: ...

    def begin(self, runs: Sequence[Run], n_finished: int) -> None:
        self.lines.append(f"{len(runs)} to do, {n_finished} finished")

    def started(self, run: Run) -> None:
        self.lines.append(f"started {run.label}")

    def ended(self, run: Run, outcome: Outcome) -> None:
        self.lines.append(f"{outcome.status} {run.label} {outcome.message}")


def bring_to_end(runs: Sequence[Run], folder: Path, **options: Any) -> tuple[Summary, InlineEngine, Lines]:
    """:func:`run_comparison` in this process."""
    engine, display = InlineEngine(), Lines()
    return run_comparison(runs, folder, lambda: engine, display, **options), engine, display


def interrupt_after(run: Run, n_steps: int) -> None:
    """Execute a run whose process is stopped at a step, after a checkpoint."""
    from sb3_actpc.actpc import ActPC

    original = ActPC._store_transition

    def store(self: Any, *arguments: Any) -> Any:
        if self.num_timesteps == n_steps:
            os.kill(os.getpid(), signal.SIGTERM)
        return original(self, *arguments)

    ActPC._store_transition = store  # type: ignore[method-assign]
    try:
        assert execute_run(run, lambda line: None, lambda steps: None).status == "stopped"
    finally:
        ActPC._store_transition = original  # type: ignore[method-assign]
    assert (run.folder / CHECKPOINTS).is_dir()
