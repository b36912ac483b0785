"""Whole episodes worth imitating: the demonstrations, and the agent's own good ones (self-imitation)."""

import warnings
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_actpc.demonstrations import Demonstrations, scaled_actions
from sb3_actpc.demonstrations.rows import split_observations
from sb3_actpc.utils.nested import map_observations

Observations = np.ndarray | dict[str, np.ndarray]
TensorObservations = th.Tensor | dict[str, th.Tensor]
Weighting = Literal["returns", "uniform"]
RETURN_EXPONENT = 4.0  # an episode with half the return is imitated a sixteenth as often
PATIENCE = 20  # episodes, all with a negative return, after which the memory warns


class ImitationSamples(NamedTuple):
    """Observations and actions worth imitating, B rows of successful episodes.

    :param observations: (B, *obs_shape) numpy, unnormalised, or a dict of such
    :param actions: (B, A), scaled to [-1, 1]
    :param history: (B, H, *obs_shape), the observations before each row in its episode, oldest first; or None
    :param history_mask: (B, H), 1 where there was such an observation, or None
    """

    observations: Observations
    actions: np.ndarray
    history: Observations | None
    history_mask: np.ndarray | None


@dataclass
class Episodes:
    """Episodes laid end to end.

    :param observations: (N, *obs_shape), or a dict of such
    :param actions: (N, A), scaled to [-1, 1]
    :param starts: (N,) index of the first transition of each row's episode
    :param returns: (N,), the return of each row's episode
    """

    observations: Observations
    actions: np.ndarray
    starts: np.ndarray
    returns: np.ndarray

    @cached_property
    def weights(self) -> np.ndarray:
        """(N,), the positive returns to the power of ``RETURN_EXPONENT``."""
        return np.maximum(self.returns, 0.0) ** RETURN_EXPONENT

    @cached_property
    def cumulative_weights(self) -> np.ndarray:
        """(N,), their running sum."""
        return np.cumsum(self.weights)

    def __len__(self) -> int:
        return len(self.actions)

    @classmethod
    def from_demonstrations(
        cls, demonstrations: Demonstrations, observation_space: spaces.Space, action_space: spaces.Box
    ) -> "Episodes":
        """The demonstrations with actions scaled to [-1, 1]."""
        bounds = demonstrations.episode_bounds
        lengths = bounds[:, 1] - bounds[:, 0]
        return cls(
            observations=split_observations(observation_space, demonstrations.observations),
            actions=scaled_actions(demonstrations, action_space),
            starts=np.repeat(bounds[:, 0], lengths),
            returns=np.repeat(demonstrations.episode_returns, lengths),
        )

    def take(self, indices: np.ndarray, history: int = 0) -> ImitationSamples:
        """(B,) rows, each with ``history`` preceding observations of the same episode."""
        past, mask = self.past(indices, history)
        observations = map_observations(lambda array: array[indices], self.observations)
        return ImitationSamples(observations, self.actions[indices], past, mask)

    def past(
        self, indices: np.ndarray, history: int, including: bool = False
    ) -> tuple[Observations | None, np.ndarray | None]:
        """The ``history`` observations before each of (B,) rows, (B, H, *obs_shape), oldest first, and (B, H), 1 where there
        is one in the same episode; None and None without a history. ``including`` asks for the past of the step after each
        row, the row itself its newest part."""
        if not history:
            return None, None
        earlier = indices[:, None] + np.arange(-history, 0) + int(including)
        mask = (earlier >= self.starts[indices][:, None]).astype(np.float32)
        return map_observations(lambda array: array[np.maximum(earlier, 0)], self.observations), mask


def _arrays(episodes: Episodes) -> list[np.ndarray]:
    """All that has a row for each transition: observations (by key), actions, starts, returns, weights."""
    seen = episodes.observations
    observed = [seen[key] for key in sorted(seen)] if isinstance(seen, dict) else [seen]
    return [*observed, episodes.actions, episodes.starts, episodes.returns, episodes.weights]


class _Column:
    """
    Rows that come at the end of an array and go at its front, without a copy of the others each time.

    A row stays where it is until the array has no room for the next one; then all of them move into one that has a quarter to
    spare. None is ever written over, so that ``rows`` of before stay what they were.

    :param rows: (N, ...), the first ones
    """

    def __init__(self, rows: np.ndarray) -> None:
        self._room, self._start, self._end = rows, 0, len(rows)

    @property
    def rows(self) -> np.ndarray:
        """(N, ...), a view."""
        return self._room[self._start : self._end]

    def shift(self, n_gone: int, new: np.ndarray) -> None:
        """:param n_gone: how many of the first rows go
        :param new: (n, ...), those that come"""
        self._start += n_gone
        if self._end + len(new) > len(self._room):
            kept = self.rows
            n_rows = len(kept) + len(new)
            self._room = np.empty((n_rows + n_rows // 4, *kept.shape[1:]), kept.dtype)
            self._room[: len(kept)] = kept
            self._start, self._end = 0, len(kept)
        self._room[self._end : self._end + len(new)] = new
        self._end += len(new)


class SelfImitationMemory:
    """The actor's memory of its own goal-reaching episodes (paper: M^actor, Algorithm 1, line 29), laid end to end.

    An episode enters when its sparse return is positive and at least the best return now stored; the oldest leave when the
    capacity is passed. A task that pays negative rewards alone never gets one in: the memory warns of it, once.

    With ``takes_all`` every episode with a positive return enters; its return then says how often it is imitated.

    :param capacity: most transitions kept (an episode longer than that is not stored)
    """

    def __init__(self, capacity: int = 100_000) -> None:
        self.capacity, self.takes_all = capacity, False
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self.episodes: Episodes | None = None
        self._n_ended, self._best_ended = 0, -np.inf
        self._hold()

    def _hold(self) -> None:
        """What follows from the episodes that are stored."""
        self._columns = [] if self.episodes is None else [_Column(array) for array in _arrays(self.episodes)]
        self._size, self._n_gone = sum(self.lengths), 0
        self._bests: deque[float] = deque()  # returns that no later one passes, the best first
        for episode_return in self.returns:
            self._note_return(episode_return)

    def _note_return(self, episode_return: float) -> None:
        while self._bests and self._bests[-1] < episode_return:
            self._bests.pop()
        self._bests.append(episode_return)

    def __len__(self) -> int:
        return self._size

    @property
    def best_return(self) -> float:
        """The best sparse return stored; 0 while empty."""
        return self._bests[0] if self._bests else 0.0

    def takes(self, length: int, episode_return: float) -> bool:
        """Whether an episode of so many transitions, which has ended with this sparse return, is good and short enough."""
        self._n_ended, self._best_ended = self._n_ended + 1, max(self._best_ended, episode_return)
        if self._n_ended == PATIENCE and self._best_ended < 0.0:
            warnings.warn(
                f"all of the first {PATIENCE} episodes had a negative return: self-imitation takes episodes with a positive "
                "one alone, and none will come in if the task never pays; shift the reward above 0, or leave the memory out "
                "with replay_buffer_kwargs=dict(self_imitation_size=0)",
                stacklevel=2,
            )
        is_good = self.takes_all or episode_return >= self.best_return
        return episode_return > 0.0 and is_good and length <= self.capacity

    def store(self, observations: Observations, actions: np.ndarray, episode_return: float) -> None:
        """One whole episode: observations (T, *obs_shape) or a dict of such, actions (T, A), and its sparse return."""
        n_new = len(actions)
        starts, returns = np.full(n_new, self._n_gone + self._size), np.full(n_new, float(episode_return))
        new = Episodes(observations, actions, starts, returns)
        self.lengths.append(n_new)
        self.returns.append(episode_return)
        self._note_return(episode_return)
        self._size += n_new
        n_gone = self._forget_oldest()
        if self._columns:
            for column, array in zip(self._columns, _arrays(new), strict=True):
                column.shift(n_gone, array)
        else:
            self._columns = [_Column(array) for array in _arrays(new)]
        self.episodes = self._laid_out(observations)

    def _forget_oldest(self) -> int:
        """What is counted of the oldest episodes goes where the capacity is passed; how many transitions these had."""
        n_gone = 0
        while self._size > self.capacity:
            length, episode_return = self.lengths.pop(0), self.returns.pop(0)
            n_gone, self._size = n_gone + length, self._size - length
            if self._bests[0] == episode_return:
                self._bests.popleft()
        self._n_gone += n_gone
        return n_gone

    def _laid_out(self, like: Observations) -> Episodes:
        """The columns, in the order of :func:`_arrays`; observations are a dict where those of ``like`` are one."""
        *observed, actions, starts, returns, weights = (column.rows for column in self._columns)
        observations = dict(zip(sorted(like), observed, strict=True)) if isinstance(like, dict) else observed[0]
        episodes = Episodes(observations, actions, starts - self._n_gone, returns)
        episodes.weights = weights
        return episodes

    def __getstate__(self) -> dict[str, Any]:
        derived = ("_columns", "_size", "_n_gone", "_bests")
        return {name: value for name, value in vars(self).items() if name not in derived}

    def __setstate__(self, state: dict[str, Any]) -> None:
        if state["episodes"] is not None and "returns" not in vars(state["episodes"]):
            raise ValueError("the replay buffer is of another version of sb3_actpc: load it with that one")
        self.__dict__.update(state)
        self._hold()

    def checkpoint_state(self) -> dict[str, Any]:
        """The stored episodes and their returns, for a checkpoint."""
        episodes = None
        if self.episodes is not None:
            names = [field.name for field in fields(self.episodes)]
            episodes = {name: getattr(self.episodes, name) for name in names}
        ended = [self._n_ended, None if self._n_ended == 0 else self._best_ended]
        return {"returns": list(self.returns), "lengths": list(self.lengths), "episodes": episodes, "ended": ended}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """:param state: what :meth:`checkpoint_state` returned"""
        self.returns, self.lengths = list(state["returns"]), list(state["lengths"])
        self.episodes = None if state["episodes"] is None else Episodes(**state["episodes"])
        self._n_ended, best = state["ended"]
        self._best_ended = -np.inf if best is None else best
        self._hold()


def is_by_return(parts: list[Episodes], weighting: Weighting) -> bool:
    """Whether steps of the union of ``parts`` are drawn by returns: not where the first (the demonstrations) have none, as one
    episode of the agent's own would end their imitation."""
    return weighting == "returns" and bool(parts[0].cumulative_weights[-1] > 0.0)


def sample_union(parts: list[Episodes], n: int, history: int = 0, weighting: Weighting = "uniform") -> ImitationSamples:
    """``n`` rows drawn from the union of ``parts`` (global NumPy generator, as SB3's buffers), uniformly or, with
    "returns", by their episode's return."""
    parts = [part for part in parts if len(part)]
    by_return = is_by_return(parts, weighting)
    if by_return:
        weights = [part.cumulative_weights for part in parts]
        ends = np.cumsum([running[-1] for running in weights])
        drawn = np.sort(np.random.random(n)) * ends[-1]
    else:
        ends = np.cumsum([len(part) for part in parts])
        drawn = np.sort(np.random.randint(0, ends[-1], size=n))
    taken, start = [], 0.0
    for index, (part, end) in enumerate(zip(parts, ends, strict=True)):
        rows = drawn[(drawn >= start) & (drawn < end)] - start
        if by_return:
            rows = np.searchsorted(weights[index], rows, side="right").clip(max=len(part) - 1)
        taken.append(part.take(rows.astype(np.int64), history))
        start = end
    if len(taken) == 1:
        return taken[0]
    columns: list[Any] = [
        None if any(part is None for part in column) else _concatenate(column) for column in zip(*taken, strict=True)
    ]
    return ImitationSamples(*columns)


def _concatenate(arrays: Sequence[Any]) -> Any:
    if isinstance(arrays[0], dict):
        return {key: np.concatenate([array[key] for array in arrays]) for key in arrays[0]}
    return np.concatenate(arrays)
