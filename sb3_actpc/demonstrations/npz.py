"""The ``.npz`` file format of demonstrations: compressed, without pickles, every mistake in a file named."""

import io
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_actpc.demonstrations.rows import field_error, unchained_indices
from sb3_actpc.utils.files import atomic_write

FORMAT_VERSION = 1
OTHERS = (
    "for others: `sb3-actpc demos convert` (HDF5 of Lift and PickPlaceCan), Demonstrations.from_trajectories (of imitation's "
    "files, read with imitation.data.serialize.load), Demonstrations.from_episodes (arrays)"
)

_ARRAYS = ("observations", "actions", "rewards", "terminations", "episode_starts")
_TEXTS = ("env_id", "metadata")
_INDICES = "next_observation_indices"
_ROWS = "next_observation_rows"


def write_npz(path: str | os.PathLike[str], fields: Mapping[str, Any]) -> None:
    """Write the fields of a ``Demonstrations``, all at once or not at all. A next observation is stored only where it is
    not, bit for bit, the following row of ``observations`` of the same episode, so that the file holds the observations
    about once."""
    next_observations = fields["next_observations"]
    dense_rewards = fields["dense_rewards"]
    indices = unchained_indices(fields["observations"], next_observations, fields["episode_starts"])
    arrays = {
        "format_version": np.array(FORMAT_VERSION, dtype=np.int64),
        **{name: fields[name] for name in _ARRAYS},
        # always present, so that a lost entry is noticed; N >= 1, so empty can only mean None
        "dense_rewards": np.empty(0, dtype=np.float32) if dense_rewards is None else dense_rewards,
        _INDICES: indices,
        _ROWS: next_observations[indices],
        **{name: np.array(json.dumps(fields[name])) for name in _TEXTS},
    }
    with atomic_write(path) as file:
        np.savez_compressed(file, **arrays)


def read_npz(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The fields of a ``Demonstrations``, bit for bit as :func:`write_npz` wrote them; never unpickles. ValueError names the
    file and the entry when the file is empty, cut short, damaged, lacks an entry, holds one of a wrong type, or has a newer
    format."""
    source = str(path)
    if not os.path.exists(path):
        raise FileNotFoundError(f"no demonstrations file at {source} (ids of Minari end in -v and a number)")
    try:
        content = Path(path).read_bytes()
        archive = zipfile.ZipFile(io.BytesIO(content))
    except Exception as error:  # whatever the reader raises on bytes that are not its own
        expected = f"{source}: expected a demonstrations .npz file, as Demonstrations.save writes it"
        raise ValueError(f"{expected} ({error}); {OTHERS}") from None
    with archive:
        version = _read_array(archive, "format_version", source)
        if not np.array_equal(version, FORMAT_VERSION):
            raise field_error(source, "format_version", f"{FORMAT_VERSION} (of a newer one: update sb3-actpc)", str(version))
        stored = {name: _read_array(archive, name, source) for name in (*_ARRAYS, "dense_rewards", _INDICES, _ROWS)}
        texts = {name: _read_array(archive, name, source) for name in _TEXTS}
    dense_rewards = stored["dense_rewards"]
    return {
        **{name: stored[name] for name in _ARRAYS},
        "next_observations": _rebuild_next_observations(stored, source),
        "dense_rewards": None if dense_rewards.shape == (0,) else dense_rewards,
        **{name: _read_json(text, name, source) for name, text in texts.items()},
        "source": source,
    }


def _read_array(archive: zipfile.ZipFile, name: str, source: str) -> np.ndarray:
    """A stored entry; its checksum is verified before it is parsed."""
    if f"{name}.npy" not in archive.namelist():
        raise field_error(source, name, f"an entry {name}.npy ({OTHERS})", f"only {', '.join(archive.namelist()) or 'none'}")
    try:
        return np.lib.format.read_array(io.BytesIO(archive.read(f"{name}.npy")), allow_pickle=False)
    except Exception as error:  # the readers of zip, deflate and npy have a dozen kinds
        raise field_error(source, name, "a readable array", f"{type(error).__name__}: {str(error)[:200]}") from None


def _read_json(array: np.ndarray, name: str, source: str) -> Any:
    try:
        return json.loads(array.item())
    except (TypeError, ValueError) as error:
        raise field_error(source, name, "JSON text", f"type {array.dtype}, shape {array.shape} ({error})") from None


def _rebuild_next_observations(stored: dict[str, np.ndarray], source: str) -> np.ndarray:
    """Next observations, (N, obs_dim): the following rows, except where others are stored."""
    observations = stored["observations"]
    try:
        next_observations = np.concatenate([observations[1:], observations[-1:]])
        next_observations[stored[_INDICES]] = stored[_ROWS]
    except (IndexError, TypeError, ValueError) as error:
        raise field_error(source, _INDICES, f"indices of as many {_ROWS}", f"others ({error})") from None
    return next_observations
