"""Playing a task with someone who can do it, and keeping the episodes that succeed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from sb3_actpc.demonstrations.dataset import Demonstrations

Columns = dict[str, np.ndarray]
Report = Callable[[str], None]

COLUMNS = ("observations", "actions", "next_observations", "rewards", "terminations", "dense_rewards")


def silent(_: str) -> None:
    """Drop a progress line."""


class Demonstrator(Protocol):
    """Whoever shows how a task is done."""

    def start(self, seed: int) -> None:
        """A new episode begins; the same seed gives the same episode."""

    def predict(self, observation: np.ndarray) -> np.ndarray:
        """Action (action_dim,) in the environment's units for an observation (obs_dim,)."""


def record_successes(
    demonstrators: Sequence[Demonstrator],
    env: gym.Env[Any, Any],
    n_episodes: int,
    seed: int,
    max_tries: int | None = None,
    report: Report = silent,
) -> tuple[list[Columns], int]:
    """Play until enough episodes have succeeded. The demonstrators take turns; one who fails tries again.

    :param demonstrators: episode i is by number ``i % len(demonstrators)``
    :param env: environment whose ``info`` has ``is_success`` and ``dense_reward``
    :param n_episodes: successful episodes wanted
    :param seed: try number i is reset with the seed ``seed + i``
    :param max_tries: episodes played at most, None for ``10 * n_episodes``
    :param report: takes one line of progress per kept episode
    :return: the columns of each successful episode (floats float32), and the number of tries
    :raises ValueError: if too few of the tries succeed, or ``n_episodes`` is below 1
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes={n_episodes} must be at least 1: give the number of demonstrated episodes")
    max_tries = 10 * n_episodes if max_tries is None else max_tries
    episodes: list[Columns] = []
    n_tries = 0
    while len(episodes) < n_episodes and n_tries < max_tries:
        demonstrator = demonstrators[len(episodes) % len(demonstrators)]
        episode, success = play_episode(demonstrator, env, seed + n_tries)
        n_tries += 1
        if success:
            episodes.append(episode)
            sparse, dense = episode["rewards"].sum(), episode["dense_rewards"].sum()
            report(f"episode {len(episodes)}/{n_episodes} (try {n_tries}): sparse return {sparse:.1f}, dense {dense:.1f}")
    if len(episodes) < n_episodes:
        task = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"only {len(episodes)} of {n_tries} episodes succeeded in {task}, {n_episodes} are needed: train the expert "
            "longer (--steps), raise --max-tries, or ask for fewer episodes (--episodes)"
        )
    return episodes, n_tries


def play_episode(demonstrator: Demonstrator, env: gym.Env[Any, Any], seed: int) -> tuple[Columns, bool]:
    """
    :param demonstrator: acts
    :param env: as in :func:`record_successes`
    :param seed: of the reset and of the demonstrator
    :return: one episode as columns, and whether it ended in success
    """
    rows: dict[str, list[Any]] = {key: [] for key in COLUMNS}
    observation, info = env.reset(seed=seed)
    demonstrator.start(seed)
    done = False
    while not done:
        action = demonstrator.predict(observation)
        next_observation, reward, terminated, truncated, info = env.step(action)
        values = (observation, action, next_observation, reward, terminated, info["dense_reward"])
        for column, value in zip(rows.values(), values, strict=True):
            column.append(value)
        observation, done = next_observation, terminated or truncated
    columns = {key: np.asarray(column, dtype=np.float32) for key, column in rows.items()}
    columns["terminations"] = np.asarray(rows["terminations"], dtype=bool)
    return columns, bool(info["is_success"])


def join_episodes(
    episodes: Sequence[Columns], env_id: str, metadata: dict[str, Any], source: str = "", packages: Sequence[str] = ()
) -> Demonstrations:
    """
    :param episodes: columns of each episode, by the names of the fields of ``Demonstrations``
    :param env_id: Gymnasium id
    :param metadata: JSON values
    :param source: file they come from, for error messages
    :param packages: distributions whose versions go into the metadata
    :return: the episodes end to end
    """
    lengths = [len(episode["rewards"]) for episode in episodes]
    versions = {name: _version(name) for name in packages}
    return Demonstrations(
        **{key: np.concatenate([episode[key] for episode in episodes]) for key in episodes[0]},
        episode_starts=np.cumsum([0, *lengths[:-1]]).astype(np.int64),
        env_id=env_id,
        metadata={**versions, **metadata},
        source=source,
    )


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"
