"""Short demonstrations of any task with Box observations, recorded with random actions."""

from pathlib import Path

import gymnasium as gym

import sb3_actpc  # noqa: F401  (registers the tasks)
from sb3_actpc.demonstrations import Demonstrations


def record(env_id: str, n_episodes: int = 2, n_steps: int = 12, **env_kwargs: object) -> Demonstrations:
    """Episodes cut after ``n_steps``, as a time limit would cut them; paid as the environment pays."""
    with gym.make(env_id, max_episode_steps=n_steps, **env_kwargs) as env:
        env.action_space.seed(0)
        return Demonstrations.record(lambda _: env.action_space.sample(), env, n_episodes, only_successes=False)


def record_file(folder: Path, env_id: str, n_episodes: int = 2) -> Path:
    """The same in a file, made once."""
    path = folder / f"{env_id}.npz"
    if not path.exists():
        record(env_id, n_episodes).save(path)
    return path
