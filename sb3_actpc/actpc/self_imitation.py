"""Whole episodes worth imitating: the demonstrations, and the agent's own good ones (self-imitation)."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from sb3_actpc.actpc.batches import Observations
from sb3_actpc.utils.nested import map_observations

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
    def cumulative_weights(self) -> np.ndarray:
        """(N,), the running sum of the positive returns to the power of ``RETURN_EXPONENT``."""
        return np.cumsum(np.maximum(self.returns, 0.0) ** RETURN_EXPONENT)

    def __len__(self) -> int:
        return len(self.actions)

    def join(self, other: "Episodes") -> "Episodes":
        """These episodes, then the ``other`` ones, whose starts count from the first of these."""
        return Episodes(*(_concatenate([getattr(one, field.name) for one in (self, other)]) for field in fields(self)))

    def without_first(self, n: int) -> "Episodes":
        """All but the first ``n`` rows, which are whole episodes."""
        observations = map_observations(lambda array: array[n:], self.observations)
        return Episodes(observations, self.actions[n:], self.starts[n:] - n, self.returns[n:])

    def take(self, indices: np.ndarray, history: int = 0) -> ImitationSamples:
        """(B,) rows, each with ``history`` preceding observations of the same episode."""
        observations = map_observations(lambda array: array[indices], self.observations)
        return ImitationSamples(observations, self.actions[indices], *self.past(indices, history))

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


class SelfImitationMemory:
    """The actor's memory of its own goal-reaching episodes (paper: M^actor, Algorithm 1, line 29), laid end to end.

    An episode enters when its sparse return is positive and at least the best return now stored; the oldest leave when the
    capacity is passed. A task with negative returns alone never gets one in: the memory warns of it, once.

    With ``takes_all`` every episode with a positive return enters. Returns count from ``failure_reward`` (:meth:`count_from`).

    :param capacity: most transitions kept (an episode longer than that is not stored)
    """

    def __init__(self, capacity: int = 100_000) -> None:
        self.capacity = capacity
        self.takes_all = False
        self.failure_reward = 0.0
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self.episodes: Episodes | None = None
        self._n_ended = 0
        self._best_ended = -np.inf

    def __len__(self) -> int:
        return sum(self.lengths)

    @property
    def best_return(self) -> float:
        """The best sparse return stored; 0 while empty."""
        return max(self.returns, default=0.0)

    def takes(self, length: int, episode_return: float) -> bool:
        """Whether an episode of so many transitions, which has ended with this sparse return, is good and short enough."""
        self._n_ended += 1
        self._best_ended = max(self._best_ended, episode_return)
        if self._n_ended == PATIENCE and self._best_ended < 0.0:
            warnings.warn(
                f"all of the first {PATIENCE} episodes had a negative return, self-imitation takes positive ones: shift the "
                "reward above 0, or turn it off with replay_buffer_kwargs=dict(self_imitation_size=0)",
                stacklevel=2,
            )
        is_good = self.takes_all or episode_return >= self.best_return
        return episode_return > 0.0 and is_good and length <= self.capacity

    def count_from(self, failure_reward: float) -> None:
        """Rewards count from this one from now on, those of the stored episodes too."""
        shift = self.failure_reward - failure_reward
        self.failure_reward = failure_reward
        if shift and self.episodes is not None:
            self.returns = [value + shift * length for value, length in zip(self.returns, self.lengths, strict=True)]
            self.episodes = replace(self.episodes, returns=np.repeat(self.returns, self.lengths))

    def store(self, observations: Observations, actions: np.ndarray, episode_return: float) -> None:
        """One whole episode: observations (T, *obs_shape) or a dict of such, actions (T, A), and its sparse return."""
        n_new = len(actions)
        new = Episodes(observations, actions, np.full(n_new, len(self)), np.full(n_new, float(episode_return)))
        self.episodes = new if self.episodes is None else self.episodes.join(new)
        self.lengths.append(n_new)
        self.returns.append(episode_return)
        while len(self) > self.capacity:
            self.episodes = self.episodes.without_first(self.lengths.pop(0))
            self.returns.pop(0)

    def checkpoint_state(self) -> dict[str, Any]:
        """The stored episodes and their returns, for a checkpoint."""
        episodes = None if self.episodes is None else {one.name: getattr(self.episodes, one.name) for one in fields(Episodes)}
        return {**vars(self), "episodes": episodes}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """:param state: what :meth:`checkpoint_state` returned"""
        episodes = None if state["episodes"] is None else Episodes(**state["episodes"])
        vars(self).update({**state, "episodes": episodes})


def failure_reward(rewards: np.ndarray, starts: np.ndarray) -> float:
    """What a step without success pays, by (N,) demonstrated rewards of episodes that begin at ``starts``: of two rewards the
    smaller (-1 and 0, -0.1 and 10), if it is negative, the other is not, and most episodes begin with it; else 0. It is no
    penalty then (0, and -1 for a collision or a time limit). Returns of a sparse task that count from it are not negative."""
    paid = np.unique(rewards)
    is_sparse = len(paid) == 2 and paid[1] >= 0.0 and (rewards[starts] == paid[0]).mean() > 0.5
    return min(float(paid[0]), 0.0) if is_sparse else 0.0


def is_by_return(parts: list[Episodes], weighting: Weighting) -> bool:
    """Whether steps of the union of ``parts`` are drawn by returns. Not if the first (the demonstrations) has no positive
    return, as one episode of the agent's own would end their imitation. Not if it has a negative one: then the fourth power
    depends on where the rewards have their zero."""
    first = parts[0]
    return weighting == "returns" and bool(first.cumulative_weights[-1] > 0.0) and bool(first.returns.min() >= 0.0)


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
    taken = []
    start = 0.0
    for index, (part, end) in enumerate(zip(parts, ends, strict=True)):
        rows = drawn[(drawn >= start) & (drawn < end)] - start
        if by_return:
            rows = np.searchsorted(weights[index], rows, side="right").clip(max=len(part) - 1)
        taken.append(part.take(rows.astype(np.int64), history))
        start = end
    columns: list[Any] = [None if column[0] is None else _concatenate(column) for column in zip(*taken, strict=True)]
    return ImitationSamples(*columns)


def _concatenate(arrays: Sequence[Any]) -> Any:
    if isinstance(arrays[0], dict):
        return {key: np.concatenate([array[key] for array in arrays]) for key in arrays[0]}
    return np.concatenate(arrays)
