"""Demonstrators of the sparse tasks: runs on the dense task, the best agent of which is then recorded in the sparse one.

So were those of Ororbia & Mali (arXiv 2209.09174): PPO, trained for 2000 episodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.utils import set_random_seed

from sb3_actpc.demonstrations import Demonstrations, shipped_demonstrations
from sb3_actpc.demonstrations.recording import Report, silent
from sb3_actpc.envs import ROBOSUITE_IDS, SPARSE_MUJOCO_IDS, dense_env_id, sparse_env_id
from sb3_actpc.experiments.runs.environments import check_env_id
from sb3_actpc.experiments.runs.record import CONFIG, read_run
from sb3_actpc.experiments.runs.run import finish_run, load_run
from sb3_actpc.experiments.runs.schema import Run
from sb3_actpc.utils.files import folder_lock

# name of the algorithm -> its settings in hyperparams/
DEMONSTRATOR_ALGORITHMS = {"ppo": "ppo_demonstrator", "sac": "sac", "td3": "td3_demonstrator", "trpo": "trpo"}
N_TRAINING_EPISODES = 2000  # of the paper's demonstrators
N_EVALUATION_EPISODES = 10  # enough to notice a policy that falls over now and then
EARLIER = 0.5  # share of the return at which the weaker half of a mixed set stood


@dataclass(frozen=True)
class Demonstrator:
    """A trained agent: its policy has SB3's ``predict``, for raw observations; its mean dense return is without noise."""

    policy: PolicyPredictor
    n_steps: int
    mean_return: float


def demonstrator_run(
    env_id: str,
    algo: str = "ppo",
    n_timesteps: int | None = None,
    target_return: float | None = None,
    gym_packages: Sequence[str] = (),
    **options: Any,
) -> Run:
    """The run that trains a demonstrator, with the settings in ``DEMONSTRATOR_ALGORITHMS``. A sparse MuJoCo task is learned by
    its dense base task, any other by its own rewards, for so many environment steps, by default 2000 full episodes, or until
    the mean dense return of an evaluation reaches the target. The options are further fields of a
    :class:`~sb3_actpc.experiments.runs.schema.Run`. ValueError for an unknown algorithm, a task of robosuite, or one without a
    time limit and ``n_timesteps``, gymnasium.error.Error when the environment is unknown."""
    if algo not in DEMONSTRATOR_ALGORITHMS:
        raise ValueError(f"algo={algo!r} is not one of {', '.join(DEMONSTRATOR_ALGORITHMS)}: choose one of these")
    known = sparse_env_id(env_id.rpartition(":")[2])  # this package's ids may come with its module
    if known in ROBOSUITE_IDS:
        raise ValueError(f"env_id={env_id!r} has no dense reward to learn by: use its scripted demonstrators")
    learned_id = dense_env_id(known) if known in SPARSE_MUJOCO_IDS else env_id
    if n_timesteps is None:
        check_env_id(learned_id, gym_packages)
        limit = gym.spec(learned_id).max_episode_steps
        if limit is None:
            raise ValueError(f"{learned_id} has no time limit: say with --steps how long to train")
        n_timesteps = N_TRAINING_EPISODES * limit
    options |= {"preset": DEMONSTRATOR_ALGORITHMS[algo], "demonstrations": "none", "eval_episodes": N_EVALUATION_EPISODES}
    options |= {"n_timesteps": n_timesteps, "target_return": target_return, "gym_packages": tuple(gym_packages)}
    return Run(env=learned_id, algo=algo, keep="best", **options)


def train_demonstrator(run: Run, folder: Path, report: Report = silent) -> Demonstrator:
    """Train a demonstrator (see :func:`demonstrator_run`), go on with a training that was stopped, or take the one that is
    there: the agent of the best evaluation. ValueError where that had more steps, and may have made a better demonstrator."""
    with folder_lock(folder):
        stored = read_run(folder).n_timesteps if (folder / CONFIG).is_file() else None
        if stored is not None and stored > (run.n_timesteps or 0):
            raise ValueError(
                f"{folder} holds a training of {stored} steps, not of {run.n_timesteps}: choose another --work-dir, or say "
                f"--steps {stored}"
            )
        result = finish_run(run.model_copy(update={"output": str(folder)}), report)
    if not result["kept_timesteps"]:
        report(f"{folder}: no evaluation was better than the first, of the untrained agent: train longer (--steps)")
    return Demonstrator(load_run(folder)[1], result["kept_timesteps"], result["dense_return"])


def train_mixed(run: Run, folder: Path, report: Report = silent) -> list[Demonstrator]:
    """A demonstrator, and one as it was earlier: trained alike, but stopped at half the return; the second's folder has
    ``_earlier`` at its end."""
    final = train_demonstrator(run, folder, report)
    early_run = run.model_copy(update={"target_return": share_of(final.mean_return, EARLIER)})
    return [final, train_demonstrator(early_run, folder.with_name(f"{folder.name}_earlier"), report)]


def share_of(reference: float, share: float) -> float:
    """The return of a demonstrator of that quality, between 0 and 1: the share of a positive reference, that many times a
    negative one's loss."""
    if not 0.0 < share <= 1.0:
        raise ValueError(f"quality={share} must be above 0 and at most 1: a share of the reference return")
    return reference * share if reference >= 0.0 else reference / share


def reference_return(env_id: str) -> float:
    """Mean dense return of the demonstrations of a sparse MuJoCo task that come with the package."""
    known = sparse_env_id(env_id)
    returns = Demonstrations.load(shipped_demonstrations(known)).dense_returns if known in SPARSE_MUJOCO_IDS else None
    if returns is None:
        raise FileNotFoundError(f"no reference return of {env_id} comes with the package: give --target-return, not --quality")
    return float(returns.mean())


def record_demonstrators(
    demonstrators: Sequence[Demonstrator],
    env_id: str,
    n_episodes: int = 20,
    stochastic: bool = False,
    seed: int = 0,
    metadata: dict[str, Any] | None = None,
    **options: Any,
) -> Demonstrations:
    """Record demonstrators, who take turns, in the task itself, see ``Demonstrations.record``; ``stochastic`` samples the
    actions instead of taking the most likely ones."""
    set_random_seed(seed)
    kept = {
        "demonstrator_steps": [one.n_steps for one in demonstrators],
        "demonstrator_returns": [one.mean_return for one in demonstrators],
        **(metadata or {}),
    }
    policies = [one.policy for one in demonstrators]
    options = {"deterministic": not stochastic, "seed": seed, **options}
    return Demonstrations.record(policies, env_id, n_episodes, metadata=kept, **options)
