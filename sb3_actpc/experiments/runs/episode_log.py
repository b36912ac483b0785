"""``episodes.csv``: every episode of the training, written as it ends."""

import csv
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_actpc.utils.files import atomic_write

EPISODES = "episodes.csv"
EPISODE_COLUMNS = (
    "episode",
    "timesteps",
    "seconds",
    "length",
    "sparse_return",
    "dense_return",
    "success",
    "actions_crc32",
)


class EpisodeLog(BaseCallback):
    """Appends a row to ``episodes.csv`` when a training episode ends, exploration noise and all.

    ``sparse_return`` is the sum of the environment's rewards, ``dense_return`` that of ``info["dense_reward"]`` (the
    same again where the environment does not report it), ``success`` is ``info["is_success"]`` at the end (empty where it is
    not reported), ``timesteps`` and ``seconds`` are those of the training until then. ``actions_crc32`` is the CRC-32 of all
    actions of the training so far: two runs that have the same number have taken the same actions.

    :param folder: run folder
    :param clock: seconds that the training has taken so far
    """

    def __init__(self, folder: Path, clock: Callable[[], float]) -> None:
        super().__init__()
        self.folder, self.clock = folder, clock
        self.n_episodes = 0
        self._dense_returns: list[float] = []  # of the running episode of each environment
        self._actions = 0

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder / EPISODES

    def begin(self) -> None:
        """Start the file; not called for a run that goes on from a checkpoint."""
        with atomic_write(self.path, "w") as file:
            csv.writer(file, lineterminator="\n").writerow(EPISODE_COLUMNS)

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint keeps: the running sums and the rows written so far."""
        return {
            "n_episodes": self.n_episodes,
            "dense_returns": list(self._dense_returns),
            "actions": self._actions,
            "rows": self.path.read_text(encoding="utf-8"),
        }

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """Go on where the checkpoint was taken; rows written after it are dropped, they will be written again."""
        self.n_episodes, self._actions = state["n_episodes"], state["actions"]
        self._dense_returns = list(state["dense_returns"])
        with atomic_write(self.path, "w") as file:
            file.write(state["rows"])

    def _on_training_start(self) -> None:
        self._dense_returns = [0.0] * self.training_env.num_envs

    def _on_step(self) -> bool:
        self._actions = zlib.crc32(np.ascontiguousarray(self.locals["actions"]).tobytes(), self._actions)
        for index, info in enumerate(self.locals["infos"]):
            self._dense_returns[index] += float(info.get("dense_reward", 0.0))
            if self.locals["dones"][index]:
                self._append(info, self._dense_returns[index] if "dense_reward" in info else info["episode"]["r"])
                self._dense_returns[index] = 0.0
        return True

    def _append(self, info: dict[str, Any], dense_return: float) -> None:
        self.n_episodes += 1
        success = info.get("is_success")
        row = {
            "episode": self.n_episodes,
            "timesteps": self.num_timesteps,
            "seconds": round(self.clock(), 2),
            "length": info["episode"]["l"],  # of SB3's Monitor, as the next: before any normalisation
            "sparse_return": round(info["episode"]["r"], 6),
            "dense_return": round(dense_return, 6),
            "success": None if success is None else float(success),
            "actions_crc32": self._actions,
        }
        with open(self.path, "a", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerow([row[name] for name in EPISODE_COLUMNS])
