"""Short demonstrations of any task with Box observations, recorded with random actions, and Minari's files of them."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import sb3_actpc  # noqa: F401  (registers the tasks)
from sb3_actpc.demonstrations import Demonstrations
from sb3_actpc.demonstrations.rows import split_observations


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


def write_minari(shown: Demonstrations, dataset_id: str, env: gym.Env) -> Any:
    """A new local Minari dataset of the same episodes, with the environment's id and spaces."""
    import minari
    from minari.data_collector import EpisodeBuffer

    buffers = []
    for episode in shown.episodes:
        seen = np.concatenate([episode["observations"], episode["next_observations"][-1:]])
        is_last = np.arange(len(episode["actions"])) == len(episode["actions"]) - 1
        dense = {} if shown.dense_rewards is None else {"dense_reward": np.append(np.float32(0), episode["dense_rewards"])}
        buffers.append(
            EpisodeBuffer(
                observations=split_observations(env.observation_space, seen),
                actions=split_observations(env.action_space, episode["actions"]),
                rewards=episode["rewards"],
                terminations=episode["terminations"],
                truncations=is_last & ~episode["terminations"],
                infos=dense,
            )
        )
    made = {"observation_space": env.observation_space, "action_space": env.action_space}
    return minari.create_dataset_from_buffers(dataset_id, buffers, env=env.spec, **made)
