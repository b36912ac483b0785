"""Folders of runs, written by hand."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_actpc.utils.files import folder_name

HOPPER, REACHER = "SparseHopper-v5", "SparseReacher-v5"
STEPS = (0, 5_000, 10_000)


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
    dense: Sequence[float] = (0.0, 50.0, 100.0),
    finished: bool = True,
    returns: Sequence[float] = (0.0, 1.0, 2.0),
    averages: Sequence[float | None] = (None, None, None),
    **settings: Any,
) -> Path:
    """A run of 10,000 steps with the given dense returns at ``STEPS``; 12 seconds, 2 of them evaluations."""
    folder = out / folder_name(task) / variant / f"seed{seed}_{abs(hash((variant, seed, str(settings)))):010x}"
    folder.mkdir(parents=True)
    config = {"algo": "actpc", "env": task, "task": task, "env_kwargs": {}, "seed": seed, "n_timesteps": STEPS[-1]}
    config |= {"eval_episodes": 20, "settings": settings, "versions": {"sb3-actpc": "0.5.0"}}
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    progress = {
        "timesteps": STEPS,
        "updates": [0, 400, 900],
        "seconds": [0.0, 6.0, 12.0],
        "evaluation_seconds": [0.0, 1.0, 2.0],
        "dense_return": dense,
        "dense_return_std": [0.0] * 3,
        "return": returns,
        "return_std": [0.0] * 3,
        "success": [0.0, 0.5, 1.0],
        "episode_length": [5.0] * 3,
        "actor_return": averages,
    }
    write_csv(folder / "progress.csv", progress)
    if finished:
        result = {"env": task, "algo": "actpc", "seed": seed, "timesteps": STEPS[-1], "dense_return": dense[-1]}
        (folder / "result.json").write_text(json.dumps(result), encoding="utf-8")
    return folder
