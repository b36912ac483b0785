"""Figures that results are put beside: the paper's own, and the scores of random actions and of the demonstrators.

``python -m sb3_actpc.experiments.report.references`` measures the latter two again (see :func:`main`).
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.envs import SPARSE_MUJOCO_IDS
from sb3_actpc.experiments.runs import play_episodes
from sb3_actpc.experiments.runs.config import find_demonstrations
from sb3_actpc.experiments.runs.run import make_eval_envs
from sb3_actpc.utils.files import atomic_write

PAPER_FILE = Path(__file__).with_name("paper_results.csv")
SCORES_FILE = Path(__file__).with_name("reference_scores.csv")
N_EPISODES = 20
_SCORE_COLUMNS = (
    "env",
    "measure",
    "random_score",
    "random_score_std",
    "random_episodes",
    "demonstrators_score",
    "demonstrators_score_std",
    "demonstrators_episodes",
)


@dataclass(frozen=True)
class PaperResult:
    """A row of the paper's tables (arXiv 2209.09174; five trials, mean and standard deviation).

    :param task: name of our task without its version, such as ``"SparseHopper"``
    :param algorithm: as the paper writes it
    :param algo: our name for it; empty for one that we do not have
    :param score: average return over the last 100 episodes; of robosuite tasks, success in percent
    :param score_std: its standard deviation
    :param r_stability: R-stability ("S-Dist" of robosuite tasks); None where the paper gives none
    :param r_stability_std: its standard deviation, likewise
    :param table: label of the table in the paper's source
    """

    task: str
    algorithm: str
    algo: str
    score: float
    score_std: float
    r_stability: float | None
    r_stability_std: float | None
    table: str

    @property
    def is_success(self) -> bool:
        """Whether the score is a rate of success in percent."""
        return self.table == "tab:robosuite_metrics"


@dataclass(frozen=True)
class ReferenceScore:
    """Means with which a task's evaluations are normalised.

    :param random: of uniformly random actions
    :param demonstrators: of the demonstrations that ship with the package
    :param measure: what is meant, a column of ``progress.csv``: ``"dense_return"``, or ``"success_rate"`` where the paper
        gives success (an episode that ends with it has the smaller dense return the sooner it succeeds)
    """

    random: float
    demonstrators: float
    measure: str = "dense_return"

    def normalize(self, values: Any) -> Any:
        """
        :param values: of the measure, any shape
        :return: 0 for random actions, 1 for the demonstrators
        """
        return (values - self.random) / (self.demonstrators - self.random)


@cache
def paper_results() -> tuple[PaperResult, ...]:
    """All rows of the paper's two tables of results."""
    with open(PAPER_FILE, newline="", encoding="utf-8") as file:
        return tuple(
            PaperResult(
                **{name: row[name] for name in ("task", "algorithm", "algo", "table")},
                score=float(row["score"]),
                score_std=float(row["score_std"]),
                r_stability=float(row["r_stability"]) if row["r_stability"] else None,
                r_stability_std=float(row["r_stability_std"]) if row["r_stability_std"] else None,
            )
            for row in csv.DictReader(file)
        )


def paper_results_of(env_id: str) -> list[PaperResult]:
    """
    :param env_id: Gymnasium id of a task, any version
    :return: its rows; empty for a task that the paper does not have
    """
    name = env_id.rpartition(":")[2].rpartition("-")[0]
    return [result for result in paper_results() if result.task == name]


def reference_score(env_id: str) -> ReferenceScore | None:
    """
    :param env_id: Gymnasium id of a task
    :return: its scores; None where none were measured
    """
    return _reference_scores().get(env_id)


def measure_of(env_id: str) -> str:
    """
    :param env_id: Gymnasium id of a task
    :return: the column of ``progress.csv`` by which it is compared: ``"success_rate"`` or ``"dense_return"``
    """
    reference = reference_score(env_id)
    return "dense_return" if reference is None else reference.measure


@cache
def _reference_scores() -> dict[str, ReferenceScore]:
    return {
        row["env"]: ReferenceScore(float(row["random_score"]), float(row["demonstrators_score"]), row["measure"])
        for row in _score_rows()
        if row["demonstrators_score"]
    }


def _score_rows(path: Path = SCORES_FILE) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


# ------------------------------------------------------------------ measuring


class RandomPolicy:
    """Uniformly random actions.

    :param action_space: Box with finite bounds
    :param seed: of its generator
    """

    def __init__(self, action_space: Any, seed: int) -> None:
        self.low, self.high = action_space.low, action_space.high
        self.generator = np.random.default_rng(seed)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, None]:
        """:return: actions (n, action_dim) for the n environments of ``episode_start``, and no state"""
        return self.generator.uniform(self.low, self.high, (len(episode_start), *self.low.shape)), None


def measure_scores(env_id: str, n_episodes: int = N_EPISODES, seed: int = 0) -> dict[str, Any]:
    """Play random actions, and read the demonstrations that ship with the package.

    :param env_id: Gymnasium id of a sparse task
    :param n_episodes: episodes of random actions; episode i begins with ``reset(seed=seed + i)``
    :param seed: see there
    :return: a row of ``reference_scores.csv``; the demonstrators' figures are empty for a task without demonstrations
    :raises gymnasium.error.Error: when the task is unknown
    """
    envs = make_eval_envs(env_id, {}, n_episodes)
    try:
        played = play_episodes(RandomPolicy(envs[0].action_space, seed), envs, n_episodes, seed)
    finally:
        for env in envs:
            env.close()
    path = find_demonstrations(env_id, "shipped")
    shown = None if path is None else Demonstrations.load(path)
    if any(result.is_success for result in paper_results_of(env_id)):
        row = {"env": env_id, "measure": "success_rate", **_moments("random", played.successes)}
        demonstrated = None if shown is None else (shown.episode_returns > 0).astype(float)
    else:
        row = {"env": env_id, "measure": "dense_return", **_moments("random", played.dense_returns)}
        demonstrated = None if shown is None else shown.dense_returns
    return {**row, **({} if demonstrated is None else _moments("demonstrators", demonstrated))}


def _moments(who: str, values: np.ndarray) -> dict[str, Any]:
    spread = round(float(values.std(ddof=1)), 3)
    return {f"{who}_score": round(float(values.mean()), 3), f"{who}_score_std": spread, f"{who}_episodes": len(values)}


def main(argv: Sequence[str] | None = None) -> int:
    """Measure the scores of some tasks and write them into the file, the others' rows left as they are.

    :param argv: arguments, by default those of the process
    :return: exit code
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_actpc.experiments.report.references", description=main.__doc__)
    parser.add_argument("envs", nargs="*", help="tasks (default: the sparse MuJoCo tasks that ship with demonstrations)")
    parser.add_argument("--output", type=Path, default=SCORES_FILE, help="file to write (default: the package's)")
    args = parser.parse_args(argv)
    rows: dict[str, dict[str, Any]] = {row["env"]: dict(row) for row in _score_rows(args.output)}
    for env_id in args.envs or [env_id for env_id in SPARSE_MUJOCO_IDS if env_id.endswith("-v5")]:
        rows[env_id] = measure_scores(env_id)
        print(", ".join(f"{name} {value}" for name, value in rows[env_id].items()), flush=True)
    with atomic_write(args.output, "w") as file:
        writer = csv.DictWriter(file, _SCORE_COLUMNS, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows[env_id] for env_id in sorted(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
