"""``episodes.csv``: every episode of the training, written as it ends."""

import csv
import math
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_actpc.utils.files import atomic_write

EPISODES = "episodes.csv"


def dense_reward(info: Mapping[str, Any], otherwise: Any) -> float:
    """What an environment reports beside its reward; ``otherwise`` where it reports nothing.

    :raises ValueError: for NaN and infinity, of which no mean could be made
    """
    name, reward = ("info['dense_reward']", info["dense_reward"]) if "dense_reward" in info else ("reward", otherwise)
    if not math.isfinite(reward):
        raise ValueError(f"environment: {name} is {float(reward)}: check the environment")
    return float(reward)


class CsvCallback(BaseCallback):
    """Writes rows into a CSV file; a checkpoint keeps those written so far, and the attributes ``kept``."""

    columns: ClassVar[tuple[str, ...]]
    kept: ClassVar[tuple[str, ...]]

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def begin_file(self) -> None:
        """Start the file; not called for a run that goes on from a checkpoint."""
        with atomic_write(self.path, "w") as file:
            csv.writer(file, lineterminator="\n").writerow(self.columns)

    def append(self, row: Mapping[str, Any]) -> None:
        """Write a row, by the names of the columns."""
        with open(self.path, "a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, self.columns, lineterminator="\n").writerow(row)

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {**{name: getattr(self, name) for name in self.kept}, "rows": self.path.read_text(encoding="utf-8")}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """Go on where the checkpoint was taken; rows written after it are dropped, they will be written again."""
        for name in self.kept:
            setattr(self, name, state[name])
        with atomic_write(self.path, "w") as file:
            file.write(state["rows"])


class EpisodeLog(CsvCallback):
    """Appends a row to ``episodes.csv`` when a training episode ends, exploration noise and all.

    ``return`` is the sum of the environment's rewards, ``dense_return`` that of ``info["dense_reward"]`` (the
    same again where the environment does not report it), ``success`` is ``info["is_success"]`` at the end (empty where it is
    not reported), ``timesteps`` and ``seconds`` are those of the training until then. ``actions_crc32`` is the CRC-32 of all
    actions of the training so far: two runs that have the same number have taken the same actions. ``clock`` gives the seconds
    that the training has taken so far.
    """

    columns = (
        "episode",
        "timesteps",
        "seconds",
        "length",
        "return",
        "dense_return",
        "success",
        "actions_crc32",
    )
    kept = ("n_episodes", "dense_returns", "actions")

    def __init__(self, folder: Path, clock: Callable[[], float]) -> None:
        super().__init__(folder / EPISODES)
        self.clock = clock
        self.n_episodes = self.actions = 0
        self.dense_returns: list[float] = []  # of the running episode of each environment

    def _on_training_start(self) -> None:
        self.dense_returns = [0.0] * self.training_env.num_envs

    def cut_running_episodes(self) -> None:
        """The episodes begun will not be finished: a resumed run starts them again."""
        self.dense_returns = [0.0] * len(self.dense_returns)

    def _on_step(self) -> bool:
        self.actions = zlib.crc32(np.ascontiguousarray(self.locals["actions"]).tobytes(), self.actions)
        for index, info in enumerate(self.locals["infos"]):
            self.dense_returns[index] += dense_reward(info, 0.0)
            if self.locals["dones"][index]:
                self._end(info, self.dense_returns[index] if "dense_reward" in info else info["episode"]["r"])
                self.dense_returns[index] = 0.0
        return True

    def _end(self, info: dict[str, Any], dense_return: float) -> None:
        self.n_episodes += 1
        success = info.get("is_success")
        row = {
            "episode": self.n_episodes,
            "timesteps": self.num_timesteps,
            "seconds": round(self.clock(), 2),
            "length": info["episode"]["l"],  # of SB3's Monitor, as the next: before any normalisation
            "return": round(info["episode"]["r"], 6),
            "dense_return": round(dense_return, 6),
            "success": None if success is None else float(success),
            "actions_crc32": self.actions,
        }
        self.append(row)
