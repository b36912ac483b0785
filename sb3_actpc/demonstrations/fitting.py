"""Demonstrations as the agent's environment would have recorded them."""

import dataclasses
import os
import re
import warnings
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from sb3_actpc.demonstrations.dataset import DATA_FOLDER, Demonstrations, base_name
from sb3_actpc.demonstrations.recording import wrapper_names
from sb3_actpc.demonstrations.rows import box_paths, join_observations, split_observations
from sb3_actpc.envs import SPARSE_MUJOCO_IDS, dense_env_id, sparse_env_id

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

MOST_OUTSIDE = 0.02  # share of observations that may leave their bounds, and of the range by which: some are stated roughly
MINARI_ID = re.compile(r"([\w-]+/)*[\w-]+-v\d+")


def resolve(
    source: str | os.PathLike[str] | Demonstrations, observation_space: spaces.Space[Any] | None = None
) -> Demonstrations:
    """Demonstrations from the path of an ``.npz`` file or the id of a local Minari dataset, whose Dict is flattened in the
    order of the environment's ``observation_space`` (None for its own), or as they are. FileNotFoundError when there is no
    such file or dataset, ImportError when Minari is not installed, ValueError when the file is not valid, or ``source`` is
    neither."""
    if isinstance(source, Demonstrations):
        return source
    if is_minari_id(source):
        return Demonstrations.from_minari(source, observation_space=observation_space)
    if isinstance(source, (str, os.PathLike)):
        path, parts = Path(source), PureWindowsPath(source).parts  # which knows both kinds of slash
        is_shipped = not path.exists() and parts[-3:-1] == DATA_FOLDER.parts[-2:]  # where the agent was trained, elsewhere
        return Demonstrations.load(DATA_FOLDER / parts[-1] if is_shipped else path)
    raise ValueError(
        f"demonstrations must be a file path, a Minari id or a Demonstrations object, found a {type(source).__name__}: of "
        "arrays of your own make one with Demonstrations.from_episodes"
    )


def is_minari_id(source: Any) -> bool:
    """Whether the source of demonstrations is a text that names a Minari dataset, and no file."""
    return isinstance(source, str) and MINARI_ID.fullmatch(source) is not None and not os.path.exists(source)


def fit_demonstrations(
    source: str | os.PathLike[str] | Demonstrations,
    env: "VecEnv | None",
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    limit: int | tuple[int, str] | None = None,
) -> Demonstrations:
    """The demonstrations as an environment would have recorded them: of its task, in its spaces, with its rewards.

    Those of the dense base task of a sparse one (such as Minari's ``mujoco/hopper/expert-v0``) fit too.

    :param source: of :func:`resolve`
    :param env: None where there is none yet
    :param observation_space: of the agent
    :param action_space: of the agent
    :param limit: use only this many episodes, the first ones, or so many transitions: ``(number, "transitions")``
    :raises FileNotFoundError: when there is no such file
    :raises ValueError: for demonstrations that are damaged, too few, of another task, or recorded behind other wrappers of
        observations or actions
    :warns UserWarning: where episodes are longer than the environment's time limit, observations lie outside its bounds, other
        wrappers differ, or those of the recording are not known
    """
    has_goals = env is not None and env.has_attr("goal_demonstrations")
    demonstrations = resolve(source, None if has_goals else observation_space)  # they may be of the task without goals
    number, unit = limit if isinstance(limit, (tuple, list)) else (limit, "episodes")
    try:
        demonstrations = demonstrations.select(**{f"n_{unit}": number})
    except ValueError as error:
        raise ValueError(f"n_demonstrations={limit}: {error}") from error
    env_id = None
    if env is not None:
        from sb3_actpc.utils.tasks import task_id  # heavy: demonstrations do without

        env_id = task_id(env)
        sparse_task = "" if env_id is None else sparse_env_id(env_id)
        if sparse_task in SPARSE_MUJOCO_IDS and base_name(dense_env_id(sparse_task)) == base_name(demonstrations.env_id):
            sparse_id = f"Sparse{demonstrations.env_id.rpartition(':')[2]}"  # rewarded_by gives the sparse rewards
            demonstrations = dataclasses.replace(demonstrations, env_id=sparse_id, dense_rewards=demonstrations.rewards)
        if has_goals:
            demonstrations = env.env_method("goal_demonstrations", demonstrations, indices=[0])[0]
    try:
        demonstrations.check(observation_space, action_space, env_id)
    except ValueError as error:
        fix = "record them in this environment, wrapped as it is here (Demonstrations.record)"
        if env_id is not None and base_name(env_id) != base_name(demonstrations.env_id):
            fix += f", or, if it is the same task, rename them: dataclasses.replace(demonstrations, env_id={env_id!r})"
        raise ValueError(f"{error}: {fix}") from None
    if env is None:
        return demonstrations
    from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_wrapper  # heavy: demonstrations do without

    if unwrap_vec_wrapper(env, VecNormalize) is None:  # which changes the bounds of images
        _compare_observations(demonstrations, observation_space)
    _compare_lengths(demonstrations, env)
    _check_wrappers(demonstrations, env)
    return _transposed(demonstrations, env).rewarded_by(env)


def scaled_actions(demonstrations: Demonstrations, action_space: spaces.Box) -> np.ndarray:
    """(N, action_dim) float32, the actions scaled to [-1, 1]."""
    low, high = action_space.low.ravel(), action_space.high.ravel()
    return np.clip(2.0 * (demonstrations.actions - low) / (high - low) - 1.0, -1.0, 1.0).astype(np.float32)


def _compare_observations(demonstrations: Demonstrations, space: spaces.Space[Any]) -> None:
    """A UserWarning for observations of which a part lies outside the bounds, as in other units."""
    bounds = spaces.flatten_space(space)
    assert isinstance(bounds, spaces.Box)
    [columns] = np.nonzero(np.isfinite(bounds.low) & np.isfinite(bounds.high))
    if not len(columns):
        return
    low, high = bounds.low[columns], bounds.high[columns]
    slack = MOST_OUTSIDE * (high - low)
    rows = demonstrations.observations[:, columns] if len(columns) < len(bounds.low) else demonstrations.observations
    outside = (rows < low - slack) | (rows > high + slack)
    share = outside.any(axis=1).mean()
    if share > MOST_OUTSIDE:
        row, column = np.argwhere(outside)[0]
        warnings.warn(
            f"{share:.0%} of the demonstrated observations lie outside the environment's bounds, such as "
            f"{rows[row, column]:g} in column {columns[column]}, of [{low[column]:g}, {high[column]:g}]: use its units",
            stacklevel=3,
        )


def _compare_lengths(demonstrations: Demonstrations, env: "VecEnv") -> None:
    """A UserWarning for episodes that are longer than the environment lets an episode be."""
    name = "_max_episode_steps"  # of TimeLimit; not every specification can be sent from another process
    limit = env.get_attr(name, indices=[0])[0] if env.has_attr(name) else None
    longest = int(np.diff(demonstrations.episode_bounds, axis=1).max())
    if isinstance(limit, int) and longest > limit:
        warnings.warn(
            f"demonstrated episodes have up to {longest} steps, the environment's at most {limit}: their returns cannot be "
            f"compared. Make it with gymnasium.make(..., max_episode_steps={longest}), or record in it as it is",
            stacklevel=3,
        )


def _check_wrappers(demonstrations: Demonstrations, env: "VecEnv") -> None:
    """Compare the names of the wrappers that may change units with those that the demonstrations were recorded behind."""
    from sb3_actpc.utils.tasks import written_as  # heavy: demonstrations do without

    # sb3-actpc demos collect makes the environment by its id
    is_collected = str(demonstrations.metadata.get("command", "")).startswith("sb3-actpc demos collect")
    recorded = demonstrations.metadata.get("wrappers", [] if is_collected else None)
    written = written_as(env)
    if written is None:
        warnings.warn(
            f"{type(env.unwrapped).__name__} does not name its wrappers (env_method): make sure that the demonstrations were "
            "recorded behind the same ones, in the units of the agent",
            stacklevel=3,
        )
        return
    found = wrapper_names(written)
    if found == (recorded or []):
        return
    theirs = "wrappers that are not known" if recorded is None else ", ".join(recorded) or "no wrapper"
    message = (
        f"demonstrations of {demonstrations.env_id} were recorded behind {theirs}, the agent learns behind "
        f"{', '.join(found) or 'no wrapper'}: record them in the agent's environment (Demonstrations.record). If they are in "
        "its units, say so: dataclasses.replace(demonstrations, metadata={**demonstrations.metadata, "
        f'"wrappers": {found}}})'
    )
    if recorded is not None and re.search("Observation|Action", " ".join({*found} ^ {*recorded})):
        raise ValueError(message)
    warnings.warn(message, stacklevel=3)


def _transposed(demonstrations: Demonstrations, env: "VecEnv") -> Demonstrations:
    """Images with their channels first, where SB3 has wrapped the environment so; they were recorded without."""
    from stable_baselines3.common.vec_env import VecTransposeImage, unwrap_vec_wrapper  # heavy: demonstrations do without

    wrapper = unwrap_vec_wrapper(env, VecTransposeImage)
    if wrapper is None:
        return demonstrations
    columns: dict[str, Any] = {}
    for name in ("observations", "next_observations"):
        images = split_observations(wrapper.venv.observation_space, getattr(demonstrations, name))
        columns[name] = join_observations(wrapper.transpose_observations(images), box_paths(wrapper.observation_space))
    return dataclasses.replace(demonstrations, **columns)
