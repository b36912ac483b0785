"""Demonstrations: recorded episodes as flat arrays, checked when made, with an ``.npz`` file format and Minari exchange."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_actpc.utils.files import atomic_write

FORMAT_VERSION = 1
DATA_FOLDER = Path(__file__).resolve().parents[1] / "data"
ACTION_TOLERANCE = 1e-4
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"

_STORED_FIELDS = (
    "observations",
    "actions",
    "rewards",
    "terminations",
    "episode_starts",
    "dense_rewards",
    "next_observation_indices",
    "next_observation_rows",
    "env_id",
    "metadata",
)
# what the zip, deflate and npy readers raise on bytes that are not theirs
_CORRUPT_FILE_ERRORS = (
    ValueError,
    KeyError,
    TypeError,
    SyntaxError,
    EOFError,
    OSError,
    RuntimeError,
    MemoryError,
    OverflowError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)


@dataclass(frozen=True, eq=False)
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
        observations = self._float_rows("observations")
        n_transitions = len(observations)
        self._float_rows("actions", n_transitions)
        next_observations = self._float_rows("next_observations", n_transitions)
        if next_observations.shape != observations.shape:
            raise self._error("next_observations", f"shape {observations.shape}", f"shape {next_observations.shape}")
        self._float_column("rewards", n_transitions)
        if self.dense_rewards is not None:
            self._float_column("dense_rewards", n_transitions)
        self._convert_terminations(n_transitions)
        self._convert_episode_starts(n_transitions)
        self._check_terminations_end_episodes()
        if not isinstance(self.env_id, str) or not self.env_id:
            raise self._error("env_id", "a Gymnasium environment id", repr(self.env_id))
        object.__setattr__(self, "metadata", self._json_metadata())

    def __len__(self) -> int:
        """Number of transitions N."""
        return len(self.observations)

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

    def select(self, n_episodes: int | None = None, n_transitions: int | None = None) -> Demonstrations:
        """The first episodes, or the first transitions; the last episode is then cut short where the limit falls.

        :param n_episodes: how many episodes to keep, or None for all
        :param n_transitions: how many transitions to keep of those, or None for all
        :return: the selection (its arrays are views)
        :raises ValueError: when a number is not a whole number of at least 1, or is more than there is
        """
        end = len(self)
        if n_episodes is not None:
            self._check_count("n_episodes", n_episodes, self.n_episodes)
            end = int(self.episode_bounds[n_episodes - 1, 1])
        if n_transitions is not None:
            self._check_count("n_transitions", n_transitions, end)
            end = int(n_transitions)
        return dataclasses.replace(
            self,
            observations=self.observations[:end],
            actions=self.actions[:end],
            next_observations=self.next_observations[:end],
            rewards=self.rewards[:end],
            terminations=self.terminations[:end],
            episode_starts=self.episode_starts[self.episode_starts < end],
            dense_rewards=None if self.dense_rewards is None else self.dense_rewards[:end],
        )

    def check(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any], env_id: str | None = None) -> None:
        """Check that the demonstrations fit an environment.

        :param observation_space: space whose flattened size must be obs_dim
        :param action_space: Box whose flattened size must be action_dim; the actions may leave its bounds by at most
            ``ACTION_TOLERANCE``
        :param env_id: id of the environment, or None to skip it; the version (``-v5``) may differ from the recorded one
        :raises ValueError: naming the field that does not fit, what was found and what was expected
        """
        if env_id is not None and _base_name(env_id) != _base_name(self.env_id):
            raise self._error("env_id", f"{env_id!r} (any version)", repr(self.env_id))
        obs_dim = _flat_size(observation_space)
        if self.observations.shape[1] != obs_dim:
            raise self._error("observations", f"{obs_dim} values a row", f"{self.observations.shape[1]}")
        if not isinstance(action_space, spaces.Box):
            raise self._error("actions", "a Box action space", repr(action_space))
        if self.actions.shape[1] != _flat_size(action_space):
            raise self._error("actions", f"{_flat_size(action_space)} values a row", f"{self.actions.shape[1]}")
        self._check_action_bounds(action_space.low.reshape(-1), action_space.high.reshape(-1))

    def rewarded_by(self, env: VecEnv) -> Demonstrations:
        """The same transitions with the rewards that ``env`` gives for them, under its own condition and threshold.

        :param env: an environment with a method ``demonstrated_rewards(demonstrations)``, such as this package's MuJoCo
            tasks; for any other the rewards stay as recorded
        :return: demonstrations that share every other array
        """
        if not env.has_attr("demonstrated_rewards"):
            return self
        return dataclasses.replace(self, rewards=env.env_method("demonstrated_rewards", self, indices=[0])[0])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a compressed ``.npz`` file, all at once or not at all, without pickles.

        A next observation is stored only where it is not, bit for bit, the following row of ``observations`` of the same
        episode, so that the file holds the observations about once.

        :param path: file to write (exactly this name)
        :raises OSError: when it cannot be written; an old file at ``path`` then stays as it was
        """
        indices = self._unchained_indices()
        arrays = {
            "format_version": np.array(FORMAT_VERSION, dtype=np.int64),
            "observations": self.observations,
            "actions": self.actions,
            "rewards": self.rewards,
            "terminations": self.terminations,
            "episode_starts": self.episode_starts,
            # always present, so that a lost entry is noticed; N >= 1, so empty can only mean None
            "dense_rewards": np.empty(0, dtype=np.float32) if self.dense_rewards is None else self.dense_rewards,
            "next_observation_indices": indices,
            "next_observation_rows": self.next_observations[indices],
            "env_id": np.array(json.dumps(self.env_id)),
            "metadata": np.array(json.dumps(self.metadata)),
        }
        with atomic_write(path) as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Demonstrations:
        """Read a file written by :meth:`save`; never unpickles.

        :param path: the ``.npz`` file
        :return: the demonstrations, bit for bit as saved
        :raises FileNotFoundError: when there is no such file
        :raises ValueError: when the file is empty, cut short, damaged, lacks a field, holds one of a wrong type, or has a
            newer format; the message names the file and the field
        """
        source = str(path)
        if not os.path.exists(path):
            raise FileNotFoundError(f"no demonstrations file at {source}")
        if not os.path.isfile(path):
            raise ValueError(f"{source}: expected a demonstrations file, found a folder or device")
        stored = _read_arrays(Path(path).read_bytes(), source)
        dense_rewards = stored["dense_rewards"]
        observations = stored["observations"]
        return cls(
            observations=observations,
            actions=stored["actions"],
            next_observations=_rebuild_next_observations(stored, source),
            rewards=stored["rewards"],
            terminations=stored["terminations"],
            episode_starts=stored["episode_starts"],
            env_id=_read_json(stored, "env_id", source),
            dense_rewards=None if dense_rewards.shape == (0,) else dense_rewards,
            metadata=_read_json(stored, "metadata", source),
            source=source,
        )

    @classmethod
    def from_minari(
        cls, dataset: Any, env_id: str | None = None, observation_space: spaces.Space[Any] | None = None
    ) -> Demonstrations:
        """Take over a Minari dataset (needs the ``minari`` extra).

        Dict observations are flattened in the order of the dataset's observation space. ``rewards`` become the sparse
        rewards and ``infos["dense_reward"]``, where recorded, the dense ones.

        :param dataset: a ``minari.MinariDataset``, or the id of one in the local Minari folder (nothing is downloaded)
        :param env_id: environment id; by default the one recorded in the dataset
        :param observation_space: the environment's own space, for a Dict whose keys are not in alphabetical order: Minari
            sorts them, so by default only :meth:`to_minari`'s datasets keep another order
        :return: the demonstrations
        :raises ImportError: when Minari is not installed
        :raises FileNotFoundError: when no local dataset has this id
        :raises ValueError: when the dataset has no episodes, no environment id, spaces other than Box (or Dicts of Box
            for observations), or data that fail the checks above
        """
        if isinstance(dataset, str):
            dataset = _import_minari().load_dataset(dataset)
        source = f"Minari dataset {dataset.spec.dataset_id}"
        metadata = dataset.storage.metadata
        keys = metadata.get("observation_keys", _leaf_keys(dataset.observation_space))
        if observation_space is not None:
            keys = _leaf_keys(observation_space)
        if not isinstance(dataset.action_space, spaces.Box):
            raise _field_error(source, "actions", "a Box action space", repr(dataset.action_space))
        episodes = [_episode_arrays(episode, keys, source) for episode in dataset.iterate_episodes()]
        if not episodes:
            raise _field_error(source, "observations", "at least one episode", "none")
        lengths = [len(episode["rewards"]) for episode in episodes]
        with_dense = [episode["dense_rewards"] is not None for episode in episodes]
        if any(with_dense) != all(with_dense):
            raise _field_error(
                source,
                "dense_rewards",
                "infos['dense_reward'] in every episode or none",
                f"it in {sum(with_dense)} of {len(episodes)}",
            )
        names = [name for name in episodes[0] if name != "dense_rewards" or with_dense[0]]
        return cls(
            **{name: np.concatenate([episode[name] for episode in episodes]) for name in names},
            episode_starts=np.cumsum([0, *lengths[:-1]]),
            env_id=env_id or (dataset.env_spec.id if dataset.env_spec is not None else metadata.get("env_id", "")),
            metadata=metadata.get("demonstrations_metadata", {}),
            source=source,
        )

    def to_minari(self, dataset_id: str, env: gym.Env[Any, Any] | None = None, **options: Any) -> Any:
        """Write the episodes as a new local Minari dataset (needs the ``minari`` extra).

        :param dataset_id: Minari id, such as ``"sparse-hopper/expert-v0"``; must not exist yet
        :param env: environment whose spaces and, if JSON can hold it, specification are recorded; by default ``env_id`` is
            made if it is registered, otherwise plain unbounded Box spaces are recorded
        :param options: further keywords of ``minari.create_dataset_from_buffers`` (``author``, ``description``, …)
        :return: the ``minari.MinariDataset``; :meth:`from_minari` gives equal arrays back
        :raises ImportError: when Minari is not installed
        :raises ValueError: when the id exists or is malformed, the demonstrations do not fit the environment, or an
            episode's next observations are not its following observations, which Minari cannot hold
        """
        minari = _import_minari()
        made_here = env is None and self.env_id in gym.registry
        if made_here:
            env = gym.make(self.env_id)
        try:
            return self._write_minari(minari, dataset_id, env, options)
        finally:
            if made_here and env is not None:
                env.close()

    def _write_minari(self, minari: Any, dataset_id: str, env: gym.Env[Any, Any] | None, options: dict[str, Any]) -> Any:
        observation_space: spaces.Space[Any] = _unbounded_box(self.observations.shape[1])
        action_space: spaces.Space[Any] = _unbounded_box(self.actions.shape[1])
        if env is not None:
            observation_space, action_space = env.observation_space, env.action_space
            self.check(observation_space, action_space, None if env.spec is None else env.spec.id)
        keys = _leaf_keys(observation_space)
        unchained = np.setdiff1d(self._unchained_indices(), self.episode_bounds[:, 1] - 1)
        if len(unchained) > 0:
            raise self._error(
                "next_observations",
                "the following observation at every transition within an episode",
                f"another one at transition {unchained[0]}",
            )
        dataset = minari.create_dataset_from_buffers(
            dataset_id,
            [self._minari_episode(start, end, observation_space, action_space) for start, end in self.episode_bounds],
            env=env if _has_json_spec(env) else None,
            observation_space=observation_space,
            action_space=action_space,
            **options,
        )
        dataset.storage.update_metadata(
            {
                "env_id": self.env_id,
                "demonstrations_metadata": self.metadata,
                "observation_keys": keys,
            }
        )
        return dataset

    def _minari_episode(self, start: int, end: int, observation_space: spaces.Space[Any], action_space: Any) -> Any:
        from minari.data_collector import EpisodeBuffer

        observations = np.concatenate([self.observations[start:end], self.next_observations[end - 1 : end]])
        terminations = self.terminations[start:end]
        truncations = np.zeros(end - start, dtype=bool)
        truncations[-1] = not terminations[-1]
        infos = None
        if self.dense_rewards is not None:
            # Minari records infos at the reset too
            infos = {"dense_reward": np.concatenate([np.zeros(1, dtype=np.float32), self.dense_rewards[start:end]])}
        return EpisodeBuffer(
            observations=_unflatten_rows(observations, observation_space),
            actions=_unflatten_rows(self.actions[start:end], action_space),
            rewards=self.rewards[start:end],
            terminations=terminations,
            truncations=truncations,
            infos=infos,
        )

    def _unchained_indices(self) -> np.ndarray:
        """Transitions whose next observation is not, bit for bit, the next row of the same episode, (M,) int64."""
        unchained = np.ones(len(self), dtype=bool)
        next_bits, following_bits = self.next_observations[:-1].view(np.int32), self.observations[1:].view(np.int32)
        unchained[:-1] = np.any(next_bits != following_bits, axis=1)
        unchained[self.episode_starts[1:] - 1] = True
        return np.flatnonzero(unchained)

    def _error(self, name: str, expected: str, found: str) -> ValueError:
        return _field_error(self.source, name, expected, found)

    def _numbers(self, name: str) -> np.ndarray:
        try:
            values = np.asarray(getattr(self, name))
        except ValueError:
            raise self._error(name, "an array of numbers", "rows of unequal length") from None
        if values.size == 0:
            raise self._error(name, "at least one value", f"an empty array of shape {values.shape}")
        if values.dtype.kind not in "biuf":
            raise self._error(name, "numbers", f"type {values.dtype}")
        return values

    def _floats(self, name: str) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.asarray(self._numbers(name), dtype=np.float32, order="C")
        finite = np.isfinite(values)
        if not finite.all():
            where = tuple(int(index) for index in np.argwhere(~finite)[0])
            raise self._error(name, "finite float32 values", f"{values[where]} at index {where}")
        object.__setattr__(self, name, values)
        return values

    def _float_rows(self, name: str, n_transitions: int | None = None) -> np.ndarray:
        values = self._floats(name)
        if values.ndim != 2 or (n_transitions is not None and len(values) != n_transitions):
            expected = "(N, size)" if n_transitions is None else f"({n_transitions}, size), a row per observation"
            raise self._error(name, f"shape {expected}", f"shape {values.shape}")
        return values

    def _float_column(self, name: str, n_transitions: int) -> np.ndarray:
        values = self._floats(name)
        if values.shape != (n_transitions,):
            raise self._error(name, f"shape ({n_transitions},), a value per observation", f"shape {values.shape}")
        return values

    def _convert_terminations(self, n_transitions: int) -> None:
        values = self._numbers("terminations")
        if values.shape != (n_transitions,):
            raise self._error("terminations", f"shape ({n_transitions},), a value per observation", f"shape {values.shape}")
        other = values[(values != 0) & (values != 1)]
        if len(other) > 0:
            raise self._error("terminations", "true or false", f"{other[0]}")
        object.__setattr__(self, "terminations", values.astype(bool))

    def _convert_episode_starts(self, n_transitions: int) -> None:
        values = self._numbers("episode_starts")
        if values.dtype.kind not in "iu" or values.ndim != 1:
            raise self._error("episode_starts", "a row of whole numbers", f"type {values.dtype}, shape {values.shape}")
        values = values.astype(np.int64)
        if values[0] != 0:
            raise self._error("episode_starts", "0 first", f"{values[0]}")
        wrong = np.flatnonzero(np.diff(values) <= 0)
        if len(wrong) > 0:
            pair = f"{values[wrong[0]]} and then {values[wrong[0] + 1]}"
            raise self._error("episode_starts", "strictly increasing indices", pair)
        if values[-1] >= n_transitions:
            raise self._error("episode_starts", f"indices below {n_transitions}, the number of transitions", f"{values[-1]}")
        object.__setattr__(self, "episode_starts", values)

    def _check_terminations_end_episodes(self) -> None:
        last = self.episode_bounds[:, 1] - 1
        misplaced = np.setdiff1d(np.flatnonzero(self.terminations), last)
        if len(misplaced) > 0:
            expected = "true only at the last transition of an episode (see episode_starts)"
            raise self._error("terminations", expected, f"true at transition {misplaced[0]}, inside an episode")

    def _json_metadata(self) -> dict[str, Any]:
        """A copy of the metadata as a JSON file would give it back."""
        if not isinstance(self.metadata, Mapping):
            raise self._error("metadata", "a dictionary", repr(self.metadata))
        for key, value in self.metadata.items():
            if not isinstance(key, str) or isinstance(value, Mapping):
                raise self._error("metadata", "a flat dictionary with text keys", f"{key!r}: {value!r}")
        try:
            return dict(json.loads(json.dumps(dict(self.metadata), allow_nan=False)))
        except (TypeError, ValueError) as error:
            raise self._error("metadata", "JSON values", f"{self.metadata!r} ({error})") from None

    def _check_count(self, name: str, count: int, available: int) -> None:
        is_whole = isinstance(count, (int, np.integer)) and not isinstance(count, bool)
        if not is_whole or not 1 <= count <= available:
            prefix = f"{self.source}: " if self.source else ""
            raise ValueError(f"{prefix}{name} must be a whole number from 1 to {available}, found {count!r}")

    def _check_action_bounds(self, low: np.ndarray, high: np.ndarray) -> None:
        actions = self.actions.astype(np.float64)
        outside = (actions < low - ACTION_TOLERANCE) | (actions > high + ACTION_TOLERANCE)
        if outside.any():
            row, column = (int(index) for index in np.argwhere(outside)[0])
            expected = f"values in [{low[column]}, {high[column]}] in column {column}"
            raise self._error("actions", expected, f"{self.actions[row, column]} at transition {row}")


def resolve(source: str | os.PathLike[str] | Demonstrations) -> Demonstrations:
    """Demonstrations from a file path, or as they are.

    :param source: path of an ``.npz`` file, or the demonstrations themselves
    :return: the demonstrations
    :raises FileNotFoundError: when there is no such file
    :raises ValueError: when the file is not valid, or ``source`` is neither
    """
    if isinstance(source, Demonstrations):
        return source
    if isinstance(source, (str, os.PathLike)):
        return Demonstrations.load(source)
    raise ValueError(f"demonstrations must be a file path or a Demonstrations object, found {source!r}")


def shipped_demonstrations(env_id: str, weak: bool = False) -> Path:
    """The demonstrations file of a sparse task that comes with the package.

    :param env_id: Gymnasium id, such as ``SparseHalfCheetah-v5``
    :param weak: the file of a weaker demonstrator, with about half the return; only the HalfCheetah has one
    :return: its path
    :raises FileNotFoundError: when none is shipped; the message says how to collect them
    """
    name = re.sub(r"-v\d+$", "", env_id.rpartition(":")[2])
    path = DATA_FOLDER / f"sparse_{name.removeprefix('Sparse').lower()}{'_weak' if weak else ''}.npz"
    if not path.is_file():
        raise FileNotFoundError(
            f"no {'weak ' if weak else ''}demonstrations of {env_id} are shipped: collect them (sb3-actpc demos collect --env "
            f"{env_id}) and pass --demonstrations FILE, or train without (--demonstrations none)"
        )
    return path


def _field_error(source: str, name: str, expected: str, found: str) -> ValueError:
    prefix = f"{source}: " if source else ""
    return ValueError(f"{prefix}demonstrations field '{name}': expected {expected}, found {found}")


def _base_name(env_id: str) -> str:
    """The environment id without the module before a colon and without its version."""
    return re.sub(r"-v\d+$", "", env_id.rpartition(":")[2])


def _flat_size(space: spaces.Space[Any]) -> int:
    try:
        return int(spaces.utils.flatdim(space))
    except (NotImplementedError, ValueError):
        raise ValueError(f"demonstrations need a space that can be flattened, found {space!r}") from None


def _unbounded_box(size: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)


def _read_arrays(content: bytes, source: str) -> dict[str, np.ndarray]:
    """Every stored field; each entry's checksum is verified before it is parsed."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
    except _CORRUPT_FILE_ERRORS as error:
        if content.startswith(HDF5_SIGNATURE):
            raise ValueError(
                f"{source}: expected a demonstrations .npz file, found HDF5: convert it with `sb3-actpc demos convert`"
            ) from None
        raise ValueError(f"{source}: expected a demonstrations .npz file, found {len(content)} bytes ({error})") from None
    with archive:
        version = _read_array(archive, "format_version", source)
        if version.shape != () or version.dtype.kind not in "iu" or version < 1:
            found = f"type {version.dtype}, shape {version.shape}" if version.shape else repr(version.item())
            raise _field_error(source, "format_version", "a whole number of at least 1", found)
        if version > FORMAT_VERSION:
            raise _field_error(source, "format_version", f"at most {FORMAT_VERSION} (update sb3-actpc)", str(version))
        return {name: _read_array(archive, name, source) for name in _STORED_FIELDS}


def _read_array(archive: zipfile.ZipFile, name: str, source: str) -> np.ndarray:
    if f"{name}.npy" not in archive.namelist():
        raise _field_error(source, name, f"an entry {name}.npy", f"only {', '.join(archive.namelist()) or 'none'}")
    try:
        return np.lib.format.read_array(io.BytesIO(archive.read(f"{name}.npy")), allow_pickle=False)
    except _CORRUPT_FILE_ERRORS as error:
        raise _field_error(source, name, "a readable array", f"{type(error).__name__}: {str(error)[:200]}") from None


def _read_json(stored: dict[str, np.ndarray], name: str, source: str) -> Any:
    array = stored[name]
    try:
        if array.shape == () and array.dtype.kind == "U":
            return json.loads(array.item())
    except json.JSONDecodeError as error:
        raise _field_error(source, name, "JSON text", f"{array.item()[:60]!r} ({error})") from None
    raise _field_error(source, name, "JSON text", f"type {array.dtype}, shape {array.shape}")


def _rebuild_next_observations(stored: dict[str, np.ndarray], source: str) -> np.ndarray:
    """Next observations, (N, obs_dim): the following rows, except where others are stored."""
    observations, starts = stored["observations"], stored["episode_starts"]
    indices, rows = stored["next_observation_indices"], stored["next_observation_rows"]
    if observations.ndim != 2 or len(observations) == 0 or observations.dtype.kind != "f":
        found = f"type {observations.dtype}, shape {observations.shape}"
        raise _field_error(source, "observations", "floats of shape (N, size)", found)
    if indices.dtype.kind not in "iu" or indices.ndim != 1 or np.any(np.diff(indices) <= 0):
        found = f"type {indices.dtype}, shape {indices.shape}"
        raise _field_error(source, "next_observation_indices", "increasing whole numbers", found)
    if starts.dtype.kind not in "iu" or starts.ndim != 1:
        found = f"type {starts.dtype}, shape {starts.shape}"
        raise _field_error(source, "episode_starts", "a row of whole numbers", found)
    last = np.append(starts[1:], len(observations)) - 1
    if np.any(indices < 0) or np.any(indices >= len(observations)) or not np.isin(last, indices).all():
        expected = f"indices below {len(observations)} that include the end of every episode"
        raise _field_error(source, "next_observation_indices", expected, f"{len(indices)} indices that do not")
    if rows.shape != (len(indices), observations.shape[1]) or rows.dtype != observations.dtype:
        expected = f"shape {(len(indices), observations.shape[1])} of {observations.dtype}"
        raise _field_error(source, "next_observation_rows", expected, f"shape {rows.shape} of {rows.dtype}")
    next_observations = np.empty_like(observations)
    next_observations[:-1] = observations[1:]
    next_observations[indices] = rows
    return next_observations


def _import_minari() -> Any:
    try:
        import minari
    except ImportError as error:
        raise ImportError('Minari datasets need the extra: pip install "sb3-actpc[minari]"') from error
    return minari


def _has_json_spec(env: gym.Env[Any, Any] | None) -> bool:
    """Whether Minari can record how the environment is made; it cannot for entry points that are not text."""
    try:
        return env is not None and env.spec is not None and bool(env.spec.to_json())
    except (TypeError, ValueError):
        return False


def _episode_arrays(episode: Any, keys: list[list[str]], source: str) -> dict[str, Any]:
    """One Minari episode (n + 1 observations for n steps) as rows."""
    observations = _flatten_rows(episode.observations, keys, source)
    n_steps = len(episode.rewards)
    if len(observations) != n_steps + 1:
        expected = f"{n_steps + 1} rows for {n_steps} steps in episode {episode.id}"
        raise _field_error(source, "observations", expected, f"{len(observations)}")
    dense_rewards = (episode.infos or {}).get("dense_reward")
    if dense_rewards is not None:
        dense_rewards = np.asarray(dense_rewards)[-n_steps:]  # one more when the reset's info was recorded
    return {
        "observations": observations[:-1],
        "actions": np.asarray(episode.actions).reshape(n_steps, -1),
        "next_observations": observations[1:],
        "rewards": np.asarray(episode.rewards),
        "terminations": np.asarray(episode.terminations),
        "dense_rewards": dense_rewards,
    }


def _leaf_keys(space: spaces.Space[Any]) -> list[list[str]]:
    """The way to every Box of a space, in ``flatten``'s order: ``[[]]`` for a Box, ``[["goal"], …]`` for a Dict."""
    if isinstance(space, spaces.Dict):
        return [[key, *rest] for key, part in space.items() for rest in _leaf_keys(part)]
    if not isinstance(space, spaces.Box):
        raise ValueError(f"demonstrations in Minari need a Box space (or a Dict of them), found {space!r}")
    return [[]]


def _flatten_rows(observations: Any, keys: list[list[str]], source: str) -> np.ndarray:
    """Minari's nested arrays, (n, ...) each, as rows (n, flat size)."""
    parts = []
    for path in keys:
        part = observations
        for key in path:
            if not isinstance(part, Mapping) or key not in part:
                raise _field_error(source, "observations", f"an entry {'/'.join(path)!r}", "none")
            part = part[key]
        parts.append(np.asarray(part).reshape(len(part), -1))
    return np.concatenate(parts, axis=1)


def _unflatten_rows(rows: np.ndarray, space: spaces.Space[Any]) -> Any:
    """The inverse of ``_flatten_rows``."""
    if isinstance(space, spaces.Dict):
        ends = np.cumsum([_flat_size(part) for part in space.values()])[:-1]
        parts = zip(space.items(), np.split(rows, ends, axis=1), strict=True)
        return {key: _unflatten_rows(part_rows, part) for (key, part), part_rows in parts}
    return rows.reshape(len(rows), *(space.shape or ()))
