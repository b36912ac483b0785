"""Between the observations of an environment and rows of numbers; how a wrong field of demonstrations is named."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

ACTION_TOLERANCE = 1e-4  # by which actions may leave their bounds


def field_error(source: str, name: str, expected: str, found: str) -> ValueError:
    """The error to raise for a field of demonstrations from a file or data set (or an empty text)."""
    prefix = f"{source}: " if source else ""
    return ValueError(f"{prefix}demonstrations field '{name}': expected {expected}, found {found}")


def flat_size(space: spaces.Space[Any]) -> int:
    """How many numbers an element of a space has when flattened; ValueError for a space that cannot be."""
    try:
        return int(spaces.utils.flatdim(space))
    except (NotImplementedError, ValueError):
        raise ValueError(f"demonstrations need a space that can be flattened, found {space!r}") from None


def box_paths(space: spaces.Space[Any]) -> list[list[str]]:
    """The way to every Box, in the order of ``gymnasium.spaces.utils.flatten``: ``[[]]`` for a Box, ``[["goal"], ...]`` for a
    Dict; ValueError for other spaces."""
    if isinstance(space, spaces.Dict):
        return [[key, *rest] for key, part in space.items() for rest in box_paths(part)]
    if not isinstance(space, spaces.Box):
        raise ValueError(f"demonstrations need Box observations or a Dict of Boxes, found {space!r}")
    return [[]]


def column_names(space: spaces.Space[Any]) -> list[str]:
    """A name for every column of a flattened observation: ``column 3`` of a Box, ``goal[0]`` of a Dict's entry."""
    if not isinstance(space, spaces.Dict):
        return [f"column {index}" for index in range(flat_size(space))]
    names = []
    for key, part in space.items():
        is_nested = isinstance(part, spaces.Dict)
        names += [f"{key}/{name}" if is_nested else f"{key}[{index}]" for index, name in enumerate(column_names(part))]
    return names


def flatten_observation(space: spaces.Space[Any], observation: Any) -> np.ndarray:
    """A copy of an observation of a Box, or a Dict of Boxes, as one row (flat size,), in the precision that it came in."""
    return join_observations(_batch_of_one(observation), box_paths(space))[0]


def _batch_of_one(observation: Any) -> Any:
    if isinstance(observation, Mapping):
        return {key: _batch_of_one(part) for key, part in observation.items()}
    return np.asarray(observation)[None]


def outside_bounds(actions: Any, space: spaces.Box) -> np.ndarray:
    """Which numbers of actions (..., action_dim) lie outside the bounds, by more than ``ACTION_TOLERANCE`` and what float32
    rounds away; shaped as they are."""
    low, high = (bound.ravel().astype(np.float64) for bound in (space.low, space.high))
    slack_low, slack_high = (ACTION_TOLERANCE + np.finfo(np.float32).eps * np.abs(bound) for bound in (low, high))
    values = np.asarray(actions, dtype=np.float64)
    return (values < low - slack_low) | (values > high + slack_high)


def split_observations(space: spaces.Space[Any], rows: np.ndarray) -> Any:
    """Undo ``gymnasium.spaces.utils.flatten`` for many rows at once: (N, flat size) to (N, *shape), or a dict of such, for
    a Box or a Dict of these or of further Dicts."""
    box_paths(space)
    if isinstance(space, spaces.Dict):
        ends = np.cumsum([flat_size(part) for part in space.values()])[:-1]
        parts = zip(space.items(), np.split(rows, ends, axis=1), strict=True)
        return {key: split_observations(part, part_rows) for (key, part), part_rows in parts}
    return rows.reshape(len(rows), *(space.shape or ()))


def join_observations(observations: Any, paths: list[list[str]], source: str = "") -> np.ndarray:
    """The inverse of :func:`split_observations`, given the way to every part (see :func:`box_paths`): (N, flat size);
    ValueError when a part is missing."""
    parts = []
    for path in paths:
        part = observations
        for key in path:
            try:
                part = part[key]
            except (KeyError, IndexError, TypeError, ValueError):
                raise field_error(source, "observations", f"an entry {'/'.join(path)!r}", "none") from None
        parts.append(np.asarray(part).reshape(len(part), -1))
    return np.concatenate(parts, axis=1)


def transition_columns(rows: np.ndarray, actions: Any, where: str) -> dict[str, np.ndarray]:
    """Columns of n actions and of the n + 1 observations (n + 1, obs_dim) around them; ValueError for another number."""
    n = len(actions)
    if len(rows) != n + 1:
        raise ValueError(f"{where} of {n} actions must have {n + 1} observations, found {len(rows)}")
    return {"observations": rows[:-1], "actions": np.asarray(actions).reshape(n, -1), "next_observations": rows[1:]}


def whole_columns(episode: Mapping[str, Any], known: Sequence[str], source: str) -> dict[str, Any]:
    """An episode's columns, with those that may be left out (see ``Demonstrations.from_episodes``); ValueError when another
    one is missing or unknown, when there are no steps, or not as many in every column."""
    if not isinstance(episode, Mapping):
        found = f"a {type(episode).__name__}"
        raise field_error(source, "episodes", "a sequence of dictionaries, one of each episode", found)
    for name in episode.keys() - set(known):
        raise field_error(source, name, f"one of {', '.join(known)}", "a column of this name")
    columns = {name: _array(column, name, source) for name, column in episode.items() if column is not None}
    for name in ("observations", "actions", "rewards"):
        if name not in columns:
            raise field_error(source, name, "a column of every episode", f"only {', '.join(sorted(columns)) or 'none'}")
    if columns["actions"].dtype.kind in "biu":
        found = f"whole numbers ({columns['actions'].dtype}), as of a Discrete action space; of a Box, convert them to float"
        raise field_error(source, "actions", "floats, in the units of a Box action space", found)
    n = len(columns["actions"])
    if not n:
        raise field_error(source, "actions", "a step of every episode", "an episode of none; leave it out")
    if "next_observations" not in columns:
        seen, where = np.asarray(columns["observations"]), "an episode without next_observations,"
        columns |= transition_columns(seen, columns["actions"], where)
    for name, column in columns.items():
        if len(column) != n:
            raise field_error(source, name, f"{n} rows, as the episode has actions", f"{len(column)}")
    return {"terminations": np.zeros(n, dtype=bool), **columns}


def _array(column: Any, name: str, source: str) -> np.ndarray:
    """A column as an array with a row for each step."""
    expected = "an array with a row for each step"
    if isinstance(column, Mapping) or (isinstance(column, list | tuple) and column and isinstance(column[0], Mapping)):
        flatten = "np.array([gymnasium.spaces.flatten(space, one) for one in ...])"
        raise field_error(source, name, expected, f"dictionaries: flatten them, as {flatten}")
    if isinstance(column, np.ma.MaskedArray):
        raise field_error(source, name, expected, "a masked array: fill its masked rows")
    try:
        rows = np.asarray(column)
    except ValueError as error:
        raise field_error(source, name, "rows of one size", " ".join(str(error).split())) from None
    if not rows.ndim:
        raise field_error(source, name, expected, f"{column!r}")
    return rows


def unchained_indices(observations: np.ndarray, next_observations: np.ndarray, episode_starts: np.ndarray) -> np.ndarray:
    """(M,) int64, the transitions whose next observation is not, bit for bit, the next row of the same episode;
    observations are (N, obs_dim) float32."""
    unchained = np.ones(len(observations), dtype=bool)
    unchained[:-1] = np.any(next_observations[:-1].view(np.int32) != observations[1:].view(np.int32), axis=1)
    unchained[episode_starts[1:] - 1] = True
    return np.flatnonzero(unchained)
