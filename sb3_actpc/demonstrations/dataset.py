"""Demonstrations: recorded episodes as flat arrays, checked when made."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_actpc.demonstrations.minari import minari_episodes, minari_files
from sb3_actpc.demonstrations.npz import read_npz, write_npz
from sb3_actpc.demonstrations.recording import env_name, record_episodes, trajectory_columns
from sb3_actpc.demonstrations.rows import box_paths, field_error, outside_bounds, whole_columns
from sb3_actpc.envs import SPARSE_IDS
from sb3_actpc.utils.extras import import_extra
from sb3_actpc.utils.precision import warn_of_indistinguishable

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

DATA_FOLDER = Path(__file__).resolve().parents[1] / "data"
# the fields with one row for each transition
COLUMNS = ("observations", "actions", "next_observations", "rewards", "terminations", "dense_rewards")


@dataclass(frozen=True, eq=False, repr=False)
class Demonstrations:
    """N recorded transitions, one row each, episode after episode.

    Every array is converted to the type below and checked when the object is made. For a Dict observation space a row
    is the concatenation of the flattened entries in the space's order (``gymnasium.spaces.utils.flatten``).

    :param observations: (N, obs_dim) float32
    :param actions: (N, action_dim) float32, in the environment's own units (not scaled to [-1, 1])
    :param next_observations: (N, obs_dim) float32, the observation that followed, also at the end of an episode
    :param rewards: (N,) float32, the task's sparse rewards
    :param terminations: (N,) bool, true where the task ended the episode; false where a time limit cut it. Only the
        last transition of an episode can terminate
    :param episode_starts: (n_episodes,) int64, index of each episode's first transition: 0 first, strictly increasing
    :param env_id: Gymnasium id of the environment that was recorded
    :param dense_rewards: (N,) float32 shaped rewards kept for comparison, or None
    :param metadata: flat dictionary of JSON values, such as the command that made the recording
    :param source: file the data came from; only named in error messages, not saved
    :raises ValueError: when a field has a wrong type or shape, is empty, holds NaN or infinity, or contradicts another;
        the message names the field, what was found and what was expected
    """

    observations: np.ndarray
    actions: np.ndarray
    next_observations: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    episode_starts: np.ndarray
    env_id: str
    dense_rewards: np.ndarray | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    source: str = ""

    def __post_init__(self) -> None:
        n_transitions, obs_dim = self._convert("observations", None, None).shape
        self._convert("actions", n_transitions, None)
        self._convert("next_observations", n_transitions, obs_dim)
        self._convert("rewards", n_transitions)
        if self.dense_rewards is not None:
            self._convert("dense_rewards", n_transitions)
        terminations = self._convert("terminations", n_transitions, dtype=np.bool_)
        starts = self._convert("episode_starts", None, dtype=np.int64)
        if starts[0] != 0 or np.any(np.diff(starts) <= 0) or starts[-1] >= n_transitions:
            expected = f"strictly increasing indices from 0 and below {n_transitions}, the number of transitions"
            raise self._error("episode_starts", expected, np.array2string(starts, threshold=8))
        misplaced = np.setdiff1d(np.flatnonzero(terminations), self.episode_bounds[:, 1] - 1)
        if len(misplaced) > 0:
            expected = "true only at the last transition of an episode (see episode_starts)"
            raise self._error("terminations", expected, f"true at transition {misplaced[0]}, inside an episode")
        if not isinstance(self.env_id, str) or not self.env_id:
            raise self._error("env_id", "a Gymnasium environment id", repr(self.env_id))
        try:
            metadata = json.loads(json.dumps(dict(self.metadata), allow_nan=False))
        except (TypeError, ValueError) as error:
            raise self._error("metadata", "a dictionary of JSON values", f"{self.metadata!r} ({error})") from None
        object.__setattr__(self, "metadata", metadata)

    def __len__(self) -> int:
        return len(self.observations)

    def __repr__(self) -> str:
        returns = f"mean return {self.episode_returns.mean():.1f}"
        if self.dense_returns is not None:
            returns += f" (dense {self.dense_returns.mean():.1f})"
        sizes = f"observations of {self.observations.shape[1]}, actions of {self.actions.shape[1]}"
        source = f", from {self.source}" if self.source else ""
        counts = f"{self.n_episodes} episodes, {len(self)} transitions"
        return f"Demonstrations({self.env_id}: {counts}, {sizes}, {returns}{source})"

    @property
    def n_episodes(self) -> int:
        """Number of episodes."""
        return len(self.episode_starts)

    @property
    def episode_bounds(self) -> np.ndarray:
        """First and one-past-last transition of each episode, (n_episodes, 2) int64."""
        return np.stack([self.episode_starts, np.append(self.episode_starts[1:], len(self))], axis=1)

    @property
    def episode_returns(self) -> np.ndarray:
        """Sum of each episode's sparse rewards, not discounted, (n_episodes,) float64."""
        return np.add.reduceat(self.rewards.astype(np.float64), self.episode_starts)

    @property
    def dense_returns(self) -> np.ndarray | None:
        """Sum of each episode's dense rewards, not discounted, (n_episodes,) float64; None without dense rewards."""
        if self.dense_rewards is None:
            return None
        return np.add.reduceat(self.dense_rewards.astype(np.float64), self.episode_starts)

    @classmethod
    def from_episodes(
        cls,
        episodes: Sequence[Mapping[str, Any]],
        env_id: str,
        metadata: Mapping[str, Any] | None = None,
        source: str = "",
    ) -> Demonstrations:
        """Join episodes, each a dictionary of columns named as in ``COLUMNS``; those of two sets of demonstrations are
        ``[*first.episodes, *second.episodes]``.

        :param episodes: columns of n rows. ``next_observations`` may be left out where ``observations`` has n + 1 rows, and
            ``terminations`` where time limits ended all episodes. Dense rewards are kept if all episodes have them
        :param env_id: the environment that was recorded
        :param metadata: JSON values
        :param source: for error messages
        :raises ValueError: when there are no episodes, or columns do not fit together
        :warns UserWarning: for features of the observations that float32 cannot follow, and for episodes without
            ``terminations`` that are shorter than the environment's time limit
        """
        if isinstance(episodes, Mapping):
            raise field_error(
                source, "episodes", "a list of dictionaries, one of each episode", "one dictionary: put it in a list"
            )
        given = list(episodes)
        episodes = [whole_columns(episode, COLUMNS, source) for episode in given]
        if not episodes:
            raise field_error(source, "episodes", "at least one episode", "none")
        columns = {}
        for name in [name for name in COLUMNS if all(name in episode for episode in episodes)]:
            try:
                columns[name] = np.concatenate([episode[name] for episode in episodes])
            except ValueError as error:
                raise field_error(source, name, "rows of one size in every episode", str(error)) from None
        warn_of_indistinguishable(columns["observations"], source)
        starts = np.cumsum([0, *(len(episode["rewards"]) for episode in episodes[:-1])])
        made = cls(**columns, episode_starts=starts, env_id=env_id, metadata=dict(metadata or {}), source=source)
        _warn_of_missing_terminations([len(one["rewards"]) for one in given if one.get("terminations") is None], env_id)
        return made

    @classmethod
    def record(
        cls,
        demonstrator: Any,
        env: gym.Env[Any, Any] | str,
        n_episodes: int = 20,
        only_successes: bool | None = None,
        *,
        metadata: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> Demonstrations:
        """Record episodes of a policy.

        :param demonstrator: an object with SB3's ``predict`` (a model's ``VecNormalize`` is applied), a function from an
            observation to an action in the environment's units, or a list of such, which alternate. A method
            ``start(seed)`` is called at every new episode
        :param env: any Gymnasium environment with Box actions and Box observations, or a Dict of such; or its id
        :param n_episodes: episodes wanted
        :param only_successes: keep only episodes that end with a true ``info["is_success"]`` (or ``"success"``); None: all but
            those that end with a false one; False: all
        :param metadata: JSON values to keep with the demonstrations
        :param options: ``deterministic`` (of ``predict``, true by default), ``seed``, ``max_tries`` and ``report``, see
            :func:`~sb3_actpc.demonstrations.recording.record_episodes`
        :return: the episodes. ``dense_rewards`` are ``info["dense_reward"]``, or the rewards where there is none
        :raises ValueError: when too few of the tries succeed, or an argument is not allowed
        """
        if isinstance(env, str):
            with gym.make(env) as made:
                return cls.record(demonstrator, made, n_episodes, only_successes, metadata=metadata, **options)
        if not isinstance(env, gym.Env):
            raise ValueError(f"env must be a Gymnasium environment or the id of one, found {env!r}")
        demonstrators = demonstrator if demonstrator and isinstance(demonstrator, list | tuple) else [demonstrator]
        episodes, made_by = record_episodes(demonstrators, env, n_episodes, only_successes, **options)
        recorded = cls.from_episodes(episodes, env_name(env), {**made_by, **(metadata or {})})
        recorded.check(env.observation_space, env.action_space)
        return recorded

    @classmethod
    def from_trajectories(
        cls,
        trajectories: Sequence[Any],
        env_id: str,
        observation_space: spaces.Space[Any] | None = None,
        final_reward: float | None = None,
    ) -> Demonstrations:
        """Convert trajectories of the ``imitation`` library. Its files are read with ``imitation.data.serialize.load``.

        A true ``TimeLimit.truncated`` in the last info is a truncation. Where it is missing, or there are no infos, an episode
        as long as ``env_id``'s time limit is truncated; warns where no limit is known and there are no infos (imitation's
        default). ``dense_reward`` is kept if every info has it.

        :param trajectories: objects with ``obs`` (n + 1 rows), ``acts`` (n rows), ``infos`` (or None), ``terminal`` and
            perhaps ``rews``
        :param env_id: the environment that was recorded
        :param observation_space: of the environment; needed for Dict observations
        :param final_reward: reward of the last step where there are no ``rews``; all others are 0
        :raises ValueError: when something is missing, does not fit together, or is of a Discrete space
        """
        spec = gym.registry.get(env_id.rpartition(":")[2])
        limit = None if spec is None else spec.max_episode_steps
        if limit is None and any(one.infos is None and one.terminal for one in trajectories):
            warnings.warn(
                f"trajectories without infos, of {env_id}, whose time limit is not known: all their ends count as "
                "terminations; keep the infos, imitation's rollout(..., exclude_infos=False), where some are time limits",
                stacklevel=2,
            )
        columns = [trajectory_columns(one, observation_space, final_reward, limit) for one in trajectories]
        return cls.from_episodes(columns, env_id, source="trajectories")

    @property
    def episodes(self) -> Iterator[dict[str, np.ndarray]]:
        """The columns of each episode, as views; without ``dense_rewards`` where there are none."""
        columns = {name: getattr(self, name) for name in COLUMNS if getattr(self, name) is not None}
        for start, end in self.episode_bounds:
            yield {name: column[start:end] for name, column in columns.items()}

    def select(self, n_episodes: int | None = None, n_transitions: int | None = None) -> Demonstrations:
        """The first ``n_episodes``, or of those the first ``n_transitions`` (None for all): the last episode is then cut short
        where the limit falls, and the arrays are views. ValueError when a number is not a whole one of at least 1, or is more
        than there is."""
        end = len(self)
        if n_episodes is not None:
            self._check_count("n_episodes", n_episodes, self.n_episodes)
            end = int(self.episode_bounds[n_episodes - 1, 1])
        if n_transitions is not None:
            self._check_count("n_transitions", n_transitions, end)
            end = int(n_transitions)
        columns = {name: getattr(self, name)[:end] for name in COLUMNS if getattr(self, name) is not None}
        return dataclasses.replace(self, **columns, episode_starts=self.episode_starts[self.episode_starts < end])

    def check(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any], env_id: str | None = None) -> None:
        """ValueError, which names the field, what was found and what was expected, when the demonstrations do not fit an
        environment: obs_dim must be the flattened size of its observation space, action_dim that of its action space, a Box,
        whose bounds the actions may leave by at most ``ACTION_TOLERANCE``; the version (``-v5``) of ``env_id`` may differ from
        the recorded one (None: not compared)."""
        if env_id is not None and base_name(env_id) != base_name(self.env_id):
            raise self._error("env_id", f"{env_id!r} (any version)", repr(self.env_id))
        box_paths(observation_space)
        if not isinstance(action_space, spaces.Box):
            raise self._error("actions", "a Box action space", repr(action_space))
        for name, space in (("observations", observation_space), ("actions", action_space)):
            size, found = spaces.flatdim(space), getattr(self, name).shape[1]
            if size != found:
                raise self._error(name, f"{size} values a row", f"{found}")
        outside = outside_bounds(self.actions, action_space)
        if outside.any():
            row, column = (int(index) for index in np.argwhere(outside)[0])
            low, high = action_space.low.ravel()[column], action_space.high.ravel()[column]
            expected = f"values in [{low}, {high}] in column {column}"
            raise self._error("actions", expected, f"{self.actions[row, column]} at transition {row}")

    def rewarded_by(self, env: VecEnv) -> Demonstrations:
        """The same transitions with the rewards that ``env`` gives for them, under its own condition and threshold, by its
        method ``demonstrated_rewards(demonstrations)``, which this package's MuJoCo tasks have; without one, or where a
        ``gymnasium.RewardWrapper`` is outermost, as recorded."""
        if not env.has_attr("demonstrated_rewards") or env.env_is_wrapped(gym.RewardWrapper, indices=[0])[0]:
            return self
        return dataclasses.replace(self, rewards=env.env_method("demonstrated_rewards", self, indices=[0])[0])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a compressed ``.npz`` file of exactly this name, all at once or not at all, without pickles; an old file stays
        as it was when that fails (OSError)."""
        write_npz(path, vars(self))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Demonstrations:
        """Read a file written by :meth:`save`, bit for bit as it was; never unpickles. FileNotFoundError when there is no such
        file; ValueError names the file and the field when it is empty, cut short, damaged, lacks a field, holds one of a wrong
        type, or has a newer format."""
        return cls(**read_npz(path))

    @classmethod
    def from_minari(
        cls, dataset: Any, env_id: str | None = None, observation_space: spaces.Space[Any] | None = None
    ) -> Demonstrations:
        """Read a Minari dataset (needs the ``minari`` extra).

        Dict observations are flattened in the order of the dataset's observation space. ``rewards`` become the sparse
        rewards and ``infos["dense_reward"]``, where recorded, the dense ones.

        :param dataset: a ``minari.MinariDataset``, or the id of one in the local Minari folder (nothing is downloaded)
        :param env_id: by default the one recorded in the dataset
        :param observation_space: the environment's own space, for a Dict whose keys are not in alphabetical order: Minari
            sorts them
        :raises ImportError: when Minari is not installed
        :raises FileNotFoundError: when no local dataset has this id
        :raises ValueError: when the dataset has no episodes, no environment id, spaces other than Box (or Dicts of Box
            for observations), or data that fail the checks above
        """
        if isinstance(dataset, str):
            minari_files(dataset)
            dataset = import_extra("minari", "minari").load_dataset(dataset)
        source = f"Minari dataset {dataset.spec.dataset_id}"
        recorded_id = "" if dataset.env_spec is None else dataset.env_spec.id
        return cls.from_episodes(minari_episodes(dataset, observation_space, source), env_id or recorded_id, source=source)

    def _error(self, name: str, expected: str, found: str) -> ValueError:
        return field_error(self.source, name, expected, found)

    def _convert(self, name: str, *shape: int | None, dtype: type[np.generic] = np.float32) -> np.ndarray:
        """Give a field its type, if every value allows it and its shape is this one (None: any length but 0)."""
        sizes = ", ".join("1 or more" if size is None else str(size) for size in shape)
        try:
            given = np.asarray(getattr(self, name))
        except ValueError:
            raise self._error(name, f"an array of shape ({sizes})", "rows of unequal length") from None
        fits = [size in (None, found) for found, size in zip(given.shape, shape, strict=False)]
        if given.dtype.kind not in "biuf" or given.ndim != len(shape) or given.size == 0 or not all(fits):
            raise self._error(name, f"numbers of shape ({sizes})", f"type {given.dtype}, shape {given.shape}")
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.asarray(given, dtype=dtype, order="C")
        wrong = ~np.isfinite(values) if dtype is np.float32 else values != given
        if wrong.any():
            where = tuple(int(index) for index in np.argwhere(wrong)[0])
            raise self._error(name, f"finite {np.dtype(dtype)} values", f"{given[where]} at index {where}")
        object.__setattr__(self, name, values)
        return values

    def _check_count(self, name: str, count: int, available: int) -> None:
        is_whole = isinstance(count, (int, np.integer)) and not isinstance(count, bool)
        if not is_whole or not 1 <= count <= available:
            prefix = f"{self.source}: " if self.source else ""
            raise ValueError(f"{prefix}{name} must be a whole number from 1 to {available}, found {count!r}")


def shipped_demonstrations(env_id: str) -> Path:
    """The demonstrations file of a sparse task, such as ``SparseHalfCheetah-v5``, that comes with the package.
    FileNotFoundError, which says how to collect them, when none is shipped."""
    path = DATA_FOLDER / f"sparse_{base_name(env_id).removeprefix('Sparse').lower()}.npz"
    observes_more = env_id.rpartition(":")[2] == "SparseReacher-v4"  # one value more than v5, of which the file is
    if observes_more or not path.is_file():
        from sb3_actpc.utils.checks import nearest  # heavy: demonstrations do without

        near = "" if env_id in gym.registry else nearest(env_id, SPARSE_IDS)
        raise FileNotFoundError(
            f"no demonstrations of {env_id} are shipped{near}: collect them (sb3-actpc demos collect "
            f"--env {env_id}) and pass --demonstrations FILE, or train without (--demonstrations none); what is shipped: "
            "sb3-actpc list demos"
        )
    return path


def base_name(env_id: str) -> str:
    """The environment id without the module before a colon and without its version."""
    return re.sub(r"-v\d+$", "", env_id.rpartition(":")[2])


def _warn_of_missing_terminations(lengths: Sequence[int], env_id: str) -> None:
    """A UserWarning for episodes without ``terminations``, of these lengths, that no time limit can have ended."""
    spec = gym.registry.get(env_id.rpartition(":")[2])
    if not lengths or spec is None:
        return
    limit = spec.max_episode_steps
    if limit is None or min(lengths) < limit:
        warnings.warn(
            f"episodes without 'terminations' count as ended by a time limit, but one has {min(lengths)} steps and {env_id} "
            f"{'no limit' if limit is None else f'a limit of {limit}'}: give the column, true where the task ended one",
            stacklevel=3,
        )
