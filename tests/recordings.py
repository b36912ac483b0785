"""Short demonstrations of any task with Box observations, recorded with random actions."""

from pathlib import Path

import gymnasium as gym
import numpy as np

import sb3_actpc  # noqa: F401  (registers the tasks)
from sb3_actpc.demonstrations.dataset import Demonstrations


def record(env_id: str, n_episodes: int = 2, n_steps: int = 12, **env_kwargs: object) -> Demonstrations:
    """Episodes cut after ``n_steps``, as a time limit would cut them; paid as the environment pays."""
    env = gym.make(env_id, max_episode_steps=n_steps, **env_kwargs)
    env.action_space.seed(0)
    rows: list[tuple] = []
    starts = []
    for episode in range(n_episodes):
        starts.append(len(rows))
        observation, _ = env.reset(seed=episode)
        done = False
        while not done:
            action = env.action_space.sample()
            next_observation, reward, terminated, truncated, info = env.step(action)
            rows.append((observation, action, next_observation, reward, terminated, info.get("dense_reward", reward)))
            observation, done = next_observation, terminated or truncated
    env.close()
    observations, actions, next_observations, rewards, terminations, dense = map(np.array, zip(*rows, strict=True))
    return Demonstrations(observations, actions, next_observations, rewards, terminations, np.array(starts), env_id, dense)


def record_file(folder: Path, env_id: str, n_episodes: int = 2) -> Path:
    """The same in a file, made once."""
    path = folder / f"{env_id}.npz"
    if not path.exists():
        record(env_id, n_episodes).save(path)
    return path
