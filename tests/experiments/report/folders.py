"""Folders of runs, written by hand."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_actpc.utils.files import folder_name

HOPPER, REACHER = "SparseHopper-v5", "SparseReacher-v5"


def write_csv(path: Path, columns: dict[str, Sequence[Any]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def write_run(
    out: Path,
    task: str = HOPPER,
    variant: str = "actpc",
    seed: int = 0,
    returns: Sequence[float] = (),
    final: float = 0.0,
    algo: str = "actpc",
    checksum: int = 1,
    finished: bool = True,
    commit: str | None = None,
    dirty: bool = False,
    steps: int = 1000,
    **settings: Any,
) -> Path:
    """A run that was to have 1000 steps, with the given dense returns of its training episodes and of its last evaluation."""
    folder = out / folder_name(task) / variant / f"seed{seed}_{abs(hash((variant, seed, steps, str(settings)))):010x}"
    folder.mkdir(parents=True)
    config = {
        "algo": algo,
        "env": task,
        "task": task,
        "env_kwargs": {},
        "seed": seed,
        "n_timesteps": steps,
        "settings": settings,
        "demonstrators_return": 2000.0,
        "versions": {"sb3-actpc": "0.1.0", "torch": "2.13.0"},
        "git_commit": commit,
        "dirty": dirty,
    }
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    n = len(returns)
    progress = {
        "timesteps": [0, 500, 1000],
        "updates": [0, 400, 900],
        "seconds": [0.0, 6.0, 12.0],
        "evaluation_seconds": [0.0, 1.0, 2.0],
        "dense_return": [0.0, final / 2, final],
        "dense_return_std": [0.0] * 3,
        "sparse_return": [0.0, 1.0, 2.0],
        "sparse_return_std": [0.0] * 3,
        "success_rate": [0.0, 0.5, 1.0],
        "episode_length": [5.0] * 3,
    }
    write_csv(folder / "progress.csv", progress)
    episodes = {
        "episode": range(1, n + 1),
        "timesteps": range(5, 5 * n + 5, 5),
        "seconds": range(n),
        "length": [5] * n,
        "sparse_return": [1.0] * n,
        "dense_return": returns,
        "success": [1.0, 0.0] * (n // 2) + [1.0] * (n % 2),
        "actions_crc32": [checksum] * n,
    }
    write_csv(folder / "episodes.csv", episodes)
    diagnostics = {
        "time/total_timesteps": [500, 1000],
        "train/actor_cosine_0": ["", 0.5],
        "train/actor_ratio_0": ["", 0.25],
        "train/actor_cosine_1": [0.75, 1.0],
        "train/actor_ratio_1": [0.9, 0.8],
        "train/epistemic_signal": [0.3, 0.2],
    }
    write_csv(folder / "diagnostics.csv", diagnostics)
    if finished:
        result = {"env": task, "algo": algo, "seed": seed, "timesteps": 1000, "dense_return": final}
        (folder / "result.json").write_text(json.dumps(result), encoding="utf-8")
    return folder
