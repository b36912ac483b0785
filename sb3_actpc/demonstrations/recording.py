"""Recording episodes of trained agents, scripted demonstrators and plain functions."""

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_actpc.demonstrations.rows import (
    box_paths,
    column_names,
    flatten_observation,
    join_observations,
    outside_bounds,
    transition_columns,
)
from sb3_actpc.demonstrations.wrappers import wrapping_of
from sb3_actpc.utils.extras import installed_version
from sb3_actpc.utils.precision import warn_of_indistinguishable

Columns = dict[str, np.ndarray]
Report = Callable[[str], None]
ENDLESS = 5000  # steps of an episode, after which the user is warned


def silent(_: str) -> None:
    """Drop a progress line."""


def record_episodes(
    demonstrators: Sequence[Any],
    env: gym.Env[Any, Any],
    n_episodes: int,
    only_successes: bool | None = None,
    deterministic: bool = True,
    seed: int = 0,
    max_tries: int | None = None,
    report: Report = silent,
) -> tuple[list[Columns], dict[str, Any]]:
    """Play until enough episodes are kept.

    :param demonstrators: as of ``Demonstrations.record``; number ``i % len(demonstrators)`` records episode i, and tries again
        after a failure
    :param deterministic: of ``predict``; False samples the actions of a stochastic policy, from SB3's generators
    :param seed: try number i is reset with the seed ``seed + i``
    :param max_tries: episodes played at most, None for ``10 * n_episodes``
    :param report: takes one line of progress per kept episode
    :return: the columns of each episode (floats float32), and how they were made
    :raises ValueError: if too few of the tries succeed, or an argument is not allowed

    For the other parameters see ``Demonstrations.record``.
    """
    numbers: list[tuple[str, Any, int]] = [("n_episodes", n_episodes, 1), ("max_tries", max_tries, 1), ("seed", seed, 0)]
    for name, value, least in numbers:
        is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not (is_whole and value >= least) and (value is not None or name == "n_episodes"):
            raise ValueError(f"{name}={value!r} must be at least {least}, a whole number")
    if not isinstance(env.action_space, spaces.Box):
        raise ValueError(f"demonstrations need a Box action space, found {env.action_space}")
    box_paths(env.observation_space)
    if not demonstrators:
        raise ValueError("demonstrator=[] must be at least one: an object with predict, or a function of the observation")
    max_tries = 10 * n_episodes if max_tries is None else max_tries
    actors = [_actor(demonstrator, deterministic) for demonstrator in demonstrators]
    episodes: list[Columns] = []
    n_tries = 0
    while len(episodes) < n_episodes and n_tries < max_tries:
        turn = len(episodes) % len(actors)
        start = getattr(demonstrators[turn], "start", None)
        if start is not None:
            start(seed + n_tries)
        episode, info = _play(actors[turn], env, seed + n_tries)
        n_tries += 1
        if _is_kept(info, only_successes):
            episodes.append(episode)
            returns = f"return {episode['rewards'].sum():.1f}, dense {episode['dense_rewards'].sum():.1f}"
            report(f"episode {len(episodes)}/{n_episodes} (try {n_tries}): {returns}")
    if len(episodes) < n_episodes:
        raise ValueError(
            f"only {len(episodes)} of {n_tries} episodes succeeded in {env_name(env)}, {n_episodes} are needed: take a better "
            "demonstrator (train it longer: --steps), allow more tries (--max-tries, max_tries=), ask for fewer episodes "
            "(--episodes, n_episodes=), or keep those that fail too (only_successes=False)"
        )
    made_by: dict[str, Any] = {"seed": seed, "n_tries": n_tries, "deterministic": deterministic}
    if env.spec is not None:
        made_by["wrappers"] = list(wrapping_of(env, episodes[0]["actions"]).names)
    simulators = [name for name in ("gymnasium", "mujoco", "robosuite") if name in sys.modules]
    return _as_stored(episodes, env.observation_space), made_by | {name: installed_version(name) for name in simulators}


def env_name(env: gym.Env[Any, Any]) -> str:
    """An environment's Gymnasium id, or the name of its class where it has none."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


def time_limit(env_id: str) -> int | None:
    """After how many steps Gymnasium cuts the episodes of a registered environment; None where that is not known."""
    spec = gym.registry.get(env_id.rpartition(":")[2])
    return None if spec is None else spec.max_episode_steps


def trajectory_columns(
    trajectory: Any,
    observation_space: spaces.Space[Any] | None = None,
    final_reward: float | None = None,
    limit: int | None = None,
) -> Columns:
    """The columns of a trajectory, see ``Demonstrations.from_trajectories``; without infos one of ``limit`` steps was cut.
    ValueError when something needed is missing."""
    observations = trajectory.obs.unwrap() if hasattr(trajectory.obs, "unwrap") else trajectory.obs
    if isinstance(observations, Mapping) and observation_space is None:
        raise ValueError("trajectories with dict observations need observation_space: give the environment's")
    if not isinstance(observations, Mapping) and np.ndim(observations) < 2:
        raise ValueError(
            f"trajectories need Box observations, found obs of shape {np.shape(observations)}, as of a Discrete space"
        )
    rows = join_observations(observations, [[]] if observation_space is None else box_paths(observation_space))
    n_steps = len(trajectory.acts)
    infos = [{}] * n_steps if trajectory.infos is None else [info or {} for info in trajectory.infos]
    if n_steps < 1 or len(infos) != n_steps:
        raise ValueError(f"trajectories need at least 1 action and an info of each, found {n_steps} acts, {len(infos)} infos")
    columns = transition_columns(rows, trajectory.acts, "a trajectory")
    rewards = getattr(trajectory, "rews", None)
    if rewards is None:
        if final_reward is None:
            raise ValueError("trajectories without rews need final_reward, the reward of each one's last step (1.0, say)")
        rewards = np.append(np.zeros(n_steps - 1), final_reward)
    columns |= {"rewards": np.asarray(rewards), "terminations": np.zeros(n_steps, dtype=bool)}
    was_cut = infos[-1].get("TimeLimit.truncated", n_steps == limit)  # Stable-Baselines3 writes it, Gymnasium does not
    columns["terminations"][-1] = trajectory.terminal and not was_cut
    if all("dense_reward" in info for info in infos):
        columns["dense_rewards"] = np.array([info["dense_reward"] for info in infos])
    return columns


def _actor(demonstrator: Any, deterministic: bool) -> Callable[[Any, bool], np.ndarray]:
    """A function of the observation, and of whether an episode begins, to the action."""
    predict = getattr(demonstrator, "predict", None)
    if predict is None:
        if not callable(demonstrator):
            raise ValueError(f"{demonstrator!r} must have SB3's predict, or be a function from an observation to an action")
        return lambda observation, is_start: demonstrator(observation)
    normalization = getattr(demonstrator, "get_vec_normalize_env", lambda: None)()
    state = None

    def act(observation: Any, is_start: bool) -> np.ndarray:
        nonlocal state
        if normalization is not None:
            observation = normalization.normalize_obs(observation)
        state = None if is_start else state
        action, state = predict(observation, state=state, episode_start=np.array([is_start]), deterministic=deterministic)
        return action

    return act


def _play(act: Callable[[Any, bool], np.ndarray], env: gym.Env[Any, Any], seed: int) -> tuple[Columns, dict[str, Any]]:
    """One episode as columns, and its last info."""
    rows: list[tuple[Any, ...]] = []
    observation, info = env.reset(seed=seed)
    # copies: the environment may go on writing on what it gave
    row = flatten_observation(env.observation_space, observation)
    done = False
    while not done:
        action = act(observation, not rows)
        if isinstance(action, tuple):
            raise ValueError(
                "the demonstrator gives a tuple: return the action alone, or give the agent itself, not its predict"
            )
        if np.shape(action) != env.action_space.shape:
            expected = f"{env_name(env)} takes {env.action_space.shape}: return an array of that shape"
            raise ValueError(f"the demonstrator gives an action of shape {np.shape(action)}, {expected}")
        row_action = np.array(action).ravel()  # a copy: environment and demonstrator may write on theirs
        if isinstance(env.action_space, spaces.Box) and outside_bounds(row_action, env.action_space).any():
            expected = f"{env_name(env)} takes {env.action_space}: clip it (numpy.clip)"
            raise ValueError(f"the demonstrator gives the action {row_action} at step {len(rows)}, {expected}")
        observation, reward, terminated, truncated, info = env.step(action)
        next_row = flatten_observation(env.observation_space, observation)
        if next_row.shape != row.shape:
            sizes = f"{next_row.size} values at step {len(rows) + 1}, after {row.size} before"
            raise ValueError(f"{env_name(env)} gives an observation of {sizes}: it must keep to its observation_space")
        rows.append((row, next_row, row_action, reward, terminated, info.get("dense_reward", reward)))
        row, done = next_row, terminated or truncated
        if len(rows) == ENDLESS:
            warnings.warn(
                f"an episode of {env_name(env)} has gone on for {ENDLESS} steps and is recorded to its end: if it never ends, "
                "limit it with gymnasium.wrappers.TimeLimit",
                stacklevel=2,
            )
    names = ("observations", "next_observations", "actions", "rewards", "terminations", "dense_rewards")
    columns = {name: np.asarray(values) for name, values in zip(names, zip(*rows, strict=True), strict=True)}
    return {**columns, "terminations": columns["terminations"].astype(bool)}, info


def _as_stored(episodes: list[Columns], space: spaces.Space[Any]) -> list[Columns]:
    """The same episodes in float32; warns of the features of the observations that it cannot hold."""
    rows = np.concatenate([episode["observations"] for episode in episodes])
    warn_of_indistinguishable(rows, "", column_names(space))
    return [
        {name: column if column.dtype == bool else column.astype(np.float32) for name, column in episode.items()}
        for episode in episodes
    ]


def _is_kept(info: Mapping[str, Any], only_successes: bool | None) -> bool:
    success = info.get("is_success", info.get("success"))
    if success is None and only_successes:
        raise ValueError(
            "only_successes=True needs an environment whose info has is_success: give False to keep every episode"
        )
    return only_successes is False or success is None or bool(success)
