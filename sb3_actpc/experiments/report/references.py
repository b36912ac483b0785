"""Figures that results are put beside: the paper's own, and the scores of random actions and of the demonstrators.

``python -m sb3_actpc.experiments.report.references`` measures the latter two again (see :func:`main`).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.envs import SPARSE_MUJOCO_IDS
from sb3_actpc.experiments.runs import play_episodes
from sb3_actpc.experiments.runs.presets import find_demonstrations
from sb3_actpc.experiments.runs.run import make_eval_envs
from sb3_actpc.utils.files import atomic_write

PAPER_FILE = Path(__file__).with_name("paper_results.csv")
SCORES_FILE = Path(__file__).with_name("reference_scores.csv")
N_EPISODES = 20
_SUCCESS_TABLE = "tab:robosuite_metrics"  # its scores are rates of success in percent


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


def paper_results(env_id: str | None = None) -> pd.DataFrame:
    """Rows of the paper's two tables of results (arXiv 2209.09174; five trials, mean and standard deviation).

    :param env_id: Gymnasium id of a task, any version; None for all
    :return: ``task`` (our name without its version), ``algorithm`` (as the paper writes it), ``algo`` (our name), ``score``
        and ``score_std`` (average return over the last 100 episodes; of robosuite tasks, success in percent),
        ``r_stability`` and ``r_stability_std`` ("S-Dist" of robosuite tasks; NaN where the paper gives none), ``table``
        (label in the paper's source), ``is_success``; no row for a task that the paper does not have
    """
    rows = pd.read_csv(PAPER_FILE)
    rows["is_success"] = rows["table"] == _SUCCESS_TABLE
    return rows if env_id is None else rows[rows["task"] == env_id.rpartition(":")[2].rpartition("-")[0]]


@cache
def reference_score(env_id: str) -> ReferenceScore | None:
    """
    :param env_id: Gymnasium id of a task
    :return: its scores; None where none were measured
    """
    row = pd.read_csv(SCORES_FILE, index_col="env").dropna().T.get(env_id)
    return None if row is None else ReferenceScore(float(row.random_score), float(row.demonstrators_score), row.measure)


def measure_of(env_id: str) -> str:
    """
    :param env_id: Gymnasium id of a task
    :return: the column of ``progress.csv`` by which it is compared: ``"success_rate"`` or ``"dense_return"``
    """
    reference = reference_score(env_id)
    return "dense_return" if reference is None else reference.measure


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
    :return: a row of ``reference_scores.csv``; the demonstrators' figures are missing for a task without demonstrations
    :raises gymnasium.error.Error: when the task is unknown
    """
    envs = make_eval_envs(env_id, {}, n_episodes)
    try:
        played = play_episodes(RandomPolicy(envs[0].action_space, seed), envs, n_episodes, seed)
    finally:
        for env in envs:
            env.close()
    is_success = bool(paper_results(env_id)["is_success"].any())
    path = find_demonstrations(env_id, "shipped")
    scores: dict[str, Any] = {"random": played.successes if is_success else played.dense_returns}
    if path is not None:
        shown = Demonstrations.load(path)
        scores["demonstrators"] = (shown.episode_returns > 0).astype(float) if is_success else shown.dense_returns
    row: dict[str, Any] = {"env": env_id, "measure": "success_rate" if is_success else "dense_return"}
    for who, values in scores.items():
        spread = round(float(values.std(ddof=1)), 3)
        row |= {f"{who}_score": round(float(values.mean()), 3), f"{who}_score_std": spread, f"{who}_episodes": len(values)}
    return row


def main(argv: Sequence[str] | None = None) -> int:
    """Measure the scores of some tasks and write them into the file, the others' rows left as they are.

    :param argv: arguments, by default those of the process
    :return: exit code
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_actpc.experiments.report.references", description=main.__doc__)
    parser.add_argument("envs", nargs="*", help="tasks (default: the sparse MuJoCo tasks that ship with demonstrations)")
    parser.add_argument("--output", type=Path, default=SCORES_FILE, help="file to write (default: the package's)")
    args = parser.parse_args(argv)
    columns = pd.read_csv(SCORES_FILE, nrows=0).columns
    known = pd.read_csv(args.output) if args.output.is_file() else pd.DataFrame(columns=columns)
    rows: dict[str, Any] = {row["env"]: row for row in known.to_dict("records")}
    for env_id in args.envs or [env_id for env_id in SPARSE_MUJOCO_IDS if env_id.endswith("-v5")]:
        rows[env_id] = measure_scores(env_id)
        print(", ".join(f"{name} {value}" for name, value in rows[env_id].items()), flush=True)
    with atomic_write(args.output, "w") as file:
        pd.DataFrame([rows[env_id] for env_id in sorted(rows)], columns=columns).convert_dtypes().to_csv(file, index=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
