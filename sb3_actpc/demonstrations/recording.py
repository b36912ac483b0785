"""Recording episodes of trained agents, scripted demonstrators and plain functions; reading the imitation library's."""

import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_actpc.demonstrations.rows import box_paths, join_observations, outside_bounds
from sb3_actpc.utils.extras import installed_version
from sb3_actpc.utils.tasks import success_of

Columns = dict[str, Any]
Report = Callable[[str], None]
RECORDED = ("observations", "next_observations", "actions", "rewards", "terminations", "dense_rewards")
ENDLESS = 5000  # steps of an episode, after which the user is warned
# wrappers that pass observations, actions and rewards on as they are, or only clip or cast them
PLAIN = {"Monitor", "TimeLimit", "PassiveEnvChecker", "RecordEpisodeStatistics", "Autoreset", "ClipAction"}
PLAIN |= {"RecordVideo", "RenderCollection", "HumanRendering", "DtypeObservation"}
PLAIN |= {"PatchedTimeLimit"}  # rl-zoo3 replaces Gymnasium's TimeLimit by it on import


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
    :return: the columns of each episode, and how they were made
    :raises ValueError: if too few of the tries succeed, or an argument is not allowed

    For the other parameters see ``Demonstrations.record``.
    """
    counts = {"n_episodes": (n_episodes, 1), "max_tries": (1 if max_tries is None else max_tries, 1), "seed": (seed, 0)}
    for name, (value, least) in counts.items():
        if not isinstance(value, Integral) or int(value) < least:
            raise ValueError(f"{name}={value!r} must be at least {least}, a whole number")
    if not isinstance(env.action_space, spaces.Box):
        raise ValueError(f"demonstrations need a Box action space, found {env.action_space}")
    box_paths(env.observation_space)
    max_tries = 10 * n_episodes if max_tries is None else max_tries
    actors = [_actor(demonstrator, deterministic) for demonstrator in demonstrators]
    episodes: list[Columns] = []
    n_tries = 0
    is_reported = False  # whether an environment says that an episode succeeded; some say nothing of a failure
    while len(episodes) < n_episodes and n_tries < max_tries:
        turn = len(episodes) % len(actors)
        start = getattr(demonstrators[turn], "start", None)
        if start is not None:
            start(seed + n_tries)
        episode, info = _play(actors[turn], env, seed + n_tries)
        n_tries += 1
        success = success_of(info)
        is_reported |= success is not None
        succeeded = not only_successes if success is None else bool(success)
        if succeeded or only_successes is False:
            episodes.append(episode)
            returns = f"return {sum(episode['rewards']):.1f}, dense {sum(episode['dense_rewards']):.1f}"
            report(f"episode {len(episodes)}/{n_episodes} (try {n_tries}): {returns}")
    if len(episodes) < n_episodes:
        needs = "; only_successes=True needs an environment whose info has is_success or success"
        raise ValueError(
            f"only {len(episodes)} of {n_tries} episodes succeeded in {env_name(env)}, {n_episodes} are needed: take a better "
            "demonstrator (train it longer: --steps), allow more tries (--max-tries, max_tries=), ask for fewer episodes "
            "(--episodes, n_episodes=), or keep those that fail too (only_successes=False)"
            f"{needs if only_successes and not is_reported else ''}"
        )
    made_by = {"seed": seed, "n_tries": n_tries, "deterministic": deterministic, "wrappers": wrapper_names(str(env))}
    simulators = [name for name in ("gymnasium", "mujoco", "robosuite") if name in sys.modules]
    return episodes, made_by | {name: installed_version(name) for name in simulators}


def env_name(env: gym.Env[Any, Any]) -> str:
    """An environment's Gymnasium id, or the name of its class where it has none."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


def wrapper_names(written: str) -> list[str]:
    """The wrappers, the outermost first, that may change what an id stands for, of an environment as Gymnasium writes it:
    ``<Monitor<RescaleAction<OrderEnforcing<PendulumEnv<Pendulum-v1>>>>>``."""
    outside = written.partition("<OrderEnforcing")[0]  # the innermost wrapper of gymnasium.make
    return [name for name in re.findall(r"<(\w+)(?=<\w+(?:[< ]|$)|$)", outside) if name not in PLAIN]


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
        raise ValueError(f"trajectories need Box observations, found obs of shape {np.shape(observations)}")
    rows = join_observations(observations, [[]] if observation_space is None else box_paths(observation_space))
    n_steps = len(trajectory.acts)
    infos = [{}] * n_steps if trajectory.infos is None else [info or {} for info in trajectory.infos]
    if n_steps < 1 or len(infos) != n_steps:
        raise ValueError(f"trajectories need at least 1 action and an info of each, found {n_steps} acts, {len(infos)} infos")
    columns: Columns = {"observations": rows, "actions": trajectory.acts, "rewards": getattr(trajectory, "rews", None)}
    if columns["rewards"] is None:
        if final_reward is None:
            raise ValueError("trajectories without rews need final_reward, the reward of each one's last step (1.0, say)")
        columns["rewards"] = np.append(np.zeros(n_steps - 1), final_reward)
    was_cut = infos[-1].get("TimeLimit.truncated", n_steps == limit)  # Stable-Baselines3 writes it, Gymnasium does not
    columns["terminations"] = [False] * (n_steps - 1) + [bool(trajectory.terminal and not was_cut)]
    if all("dense_reward" in info for info in infos):
        columns["dense_rewards"] = [info["dense_reward"] for info in infos]
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
    assert isinstance(env.action_space, spaces.Box)
    columns: Columns = {name: [] for name in RECORDED}
    observation, info = env.reset(seed=seed)
    # copies, here and below: environment and demonstrator may go on writing on what they gave
    row = spaces.flatten(env.observation_space, observation)
    done = False
    while not done:
        n_steps = len(columns["actions"])
        action = act(observation, n_steps == 0)
        is_array = not isinstance(action, tuple) and np.shape(action) == env.action_space.shape
        if not is_array or not np.isfinite(action).all() or outside_bounds(np.ravel(action), env.action_space).any():
            raise ValueError(
                f"the demonstrator gives {action!r} at step {n_steps}: {env_name(env)} takes an array of "
                f"{env.action_space} (numpy.clip keeps to the bounds; of an agent give itself, not its predict)"
            )
        row_action = np.array(action, dtype=np.float32).ravel()
        observation, reward, terminated, truncated, info = env.step(action)
        next_row = spaces.flatten(env.observation_space, observation)
        dense_reward = info.get("dense_reward", float(reward))
        values = (row, next_row, row_action, float(reward), bool(terminated), dense_reward)
        for name, value in zip(RECORDED, values, strict=True):
            columns[name].append(value)
        row = next_row
        done = terminated or truncated
        if n_steps + 1 == ENDLESS:
            limit = "limit it with gymnasium.wrappers.TimeLimit if it never ends"
            warnings.warn(f"an episode of {env_name(env)} has gone on for {ENDLESS} steps: {limit}", stacklevel=2)
    return columns, info
