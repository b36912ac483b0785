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


def box_paths(space: spaces.Space[Any]) -> list[list[str]]:
    """The way to every Box, in the order of ``gymnasium.spaces.utils.flatten``: ``[[]]`` for a Box, ``[["goal"], ...]`` for a
    Dict; ValueError for other spaces."""
    if isinstance(space, spaces.Dict):
        return [[key, *rest] for key, part in space.items() for rest in box_paths(part)]
    if not isinstance(space, spaces.Box):
        raise ValueError(f"demonstrations need Box observations or a Dict of Boxes, found {space!r}")
    return [[]]


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
    if isinstance(space, spaces.Dict):
        ends = np.cumsum([spaces.flatdim(part) for part in space.values()])[:-1]
        parts = zip(space.items(), np.split(rows, ends, axis=1), strict=True)
        return {key: split_observations(part, part_rows) for (key, part), part_rows in parts}
    return rows.reshape(len(rows), *(space.shape or ()))


def join_observations(observations: Any, paths: list[list[str]], source: str = "") -> np.ndarray:
    """The inverse of :func:`split_observations`, given the way to every part (see :func:`box_paths`): (N, flat size);
    ValueError when a part is missing, or has rows of several sizes."""
    parts = []
    for path in paths:
        part = observations
        try:
            for key in path:
                part = part[key]
            parts.append(np.asarray(part).reshape(len(part), -1))
        except (KeyError, IndexError, TypeError, ValueError):
            raise field_error(source, "/".join(["observations", *path]), "rows of one size", "none") from None
    return np.concatenate(parts, axis=1)


def whole_columns(episode: Mapping[str, Any], known: Sequence[str], source: str) -> dict[str, Any]:
    """An episode's columns, with those that may be left out (see ``Demonstrations.from_episodes``); ValueError when another
    one is missing or unknown, or is no array of numbers with a row for each step."""
    if not isinstance(episode, Mapping):
        raise field_error(source, "episodes", "a sequence of dictionaries, one of each episode", f"a {type(episode).__name__}")
    given = {name: column for name, column in episode.items() if column is not None}
    if unknown := sorted(given.keys() - set(known)):
        raise field_error(source, unknown[0], f"some of the columns {', '.join(known)}", f"{', '.join(given)}")
    if missing := sorted({"observations", "actions", "rewards"} - given.keys()):
        raise field_error(source, missing[0], "a column of this name, which is needed", f"{', '.join(given) or 'none'}")
    columns = {name: _array(column, name, source) for name, column in given.items()}
    if columns["actions"].dtype.kind != "f":
        expected = "floats, in the units of a Box action space"
        raise field_error(source, "actions", expected, f"whole numbers ({columns['actions'].dtype}), as of a Discrete one")
    n = len(columns["actions"])
    if "next_observations" not in columns:
        rows = columns["observations"]
        if not n or len(rows) != n + 1:
            raise field_error(source, "observations", "a step, and an observation more than actions", f"{len(rows)} and {n}")
        columns |= {"observations": rows[:-1], "next_observations": rows[1:]}
        columns["actions"] = columns["actions"].reshape(n, -1)
    for name, column in columns.items():
        if len(column) != n:
            raise field_error(source, name, f"{n} rows, as the episode has actions", f"{len(column)}")
    return {"terminations": np.zeros(n, dtype=bool), **columns}


def _array(column: Any, name: str, source: str) -> np.ndarray:
    """A column as an array with a row for each step."""
    try:
        rows = np.asarray(column)
    except ValueError:
        raise field_error(source, name, "rows of one size", "rows of unequal length") from None
    if not rows.ndim or rows.dtype.kind not in "biuf":
        expected = "numbers, a row for each step (of dictionaries: gymnasium.spaces.flatten of each)"
        raise field_error(source, name, expected, f"a {type(column).__name__} of type {rows.dtype}, shape {rows.shape}")
    return rows


def unchained_indices(observations: np.ndarray, next_observations: np.ndarray, episode_starts: np.ndarray) -> np.ndarray:
    """(M,) int64, the transitions whose next observation is not, bit for bit, the next row of the same episode;
    observations are (N, obs_dim) float32."""
    unchained = np.ones(len(observations), dtype=bool)
    unchained[:-1] = np.any(next_observations[:-1].view(np.int32) != observations[1:].view(np.int32), axis=1)
    unchained[episode_starts[1:] - 1] = True
    return np.flatnonzero(unchained)
