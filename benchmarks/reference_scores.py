"""The scores of random actions and of the demonstrators, with which a report normalises.

python benchmarks/reference_scores.py [ENV ...]
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_actpc.demonstrations import Demonstrations
from sb3_actpc.envs import ROBOSUITE_IDS, SPARSE_MUJOCO_IDS
from sb3_actpc.experiments.report.results import SCORES_FILE
from sb3_actpc.experiments.runs import play_episodes
from sb3_actpc.experiments.runs.presets import find_demonstrations
from sb3_actpc.experiments.runs.run import make_eval_envs
from sb3_actpc.utils.files import atomic_write

N_EPISODES = 20


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
    is_success = env_id in ROBOSUITE_IDS
    path = find_demonstrations(env_id, "shipped")
    scores: dict[str, Any] = {"random": played.successes if is_success else played.dense_returns}
    if path is not None:
        shown = Demonstrations.load(path)
        scores["demonstrators"] = (shown.episode_returns > 0).astype(float) if is_success else shown.dense_returns
    row: dict[str, Any] = {"env": env_id, "measure": "success" if is_success else "dense_return"}
    for who, values in scores.items():
        spread = round(float(values.std(ddof=1)), 3)
        row |= {f"{who}_score": round(float(values.mean()), 3), f"{who}_score_std": spread, f"{who}_episodes": len(values)}
    return row


def main(argv: Sequence[str] | None = None) -> int:
    """Measure the scores of some tasks and write them into the file, the others' rows left as they are.

    :param argv: arguments, by default those of the process
    :return: exit code
    """
    parser = argparse.ArgumentParser(description=main.__doc__)
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
