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
FROM_IMITATION = (
    "if the imitation library wrote it, read it with imitation.data.serialize.load and make "
    "Demonstrations.from_trajectories of that"
)
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"

_ARRAYS = ("observations", "actions", "rewards", "terminations", "episode_starts")
_TEXTS = ("env_id", "metadata")
_NEXT = ("next_observation_indices", "next_observation_rows")
# of what the next observations are rebuilt from: kinds of numbers, number of dimensions, shape
_FORMS = (("observations", "f", 2, "N, size"), ("episode_starts", "iu", 1, "n"), (_NEXT[0], "iu", 1, "n"))


def write_npz(path: str | os.PathLike[str], fields: Mapping[str, Any]) -> None:
    """Write the fields of a ``Demonstrations``, all at once or not at all. A next observation is stored only where it is
    not, bit for bit, the following row of ``observations`` of the same episode, so that the file holds the observations
    about once."""
    next_observations, dense_rewards = fields["next_observations"], fields["dense_rewards"]
    indices = unchained_indices(fields["observations"], next_observations, fields["episode_starts"])
    arrays = {
        "format_version": np.array(FORMAT_VERSION, dtype=np.int64),
        **{name: fields[name] for name in _ARRAYS},
        # always present, so that a lost entry is noticed; N >= 1, so empty can only mean None
        "dense_rewards": np.empty(0, dtype=np.float32) if dense_rewards is None else dense_rewards,
        **dict(zip(_NEXT, (indices, next_observations[indices]), strict=True)),
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
        raise FileNotFoundError(f"no demonstrations file at {source}")
    if not os.path.isfile(path):
        is_dataset = os.path.isfile(os.path.join(path, "dataset_info.json"))
        found = f"a folder: {FROM_IMITATION}" if is_dataset else "a folder or device"
        raise ValueError(f"{source}: expected a demonstrations file, found {found}")
    stored = _read_entries(Path(path).read_bytes(), source)
    dense_rewards = stored["dense_rewards"]
    return {
        **{name: stored[name] for name in _ARRAYS},
        "next_observations": _rebuild_next_observations(stored, source),
        "dense_rewards": None if dense_rewards.shape == (0,) else dense_rewards,
        **{name: _read_json(stored[name], name, source) for name in _TEXTS},
        "source": source,
    }


def _read_entries(content: bytes, source: str) -> dict[str, np.ndarray]:
    """Every stored entry; each one's checksum is verified before it is parsed."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
    except Exception as error:  # whatever the reader raises on bytes that are not its own
        found = f"{len(content)} bytes ({error})"
        if content.startswith(HDF5_SIGNATURE):
            found = (
                "HDF5: convert it with `sb3-actpc demos convert` if it is of robosuite's Lift or PickPlaceCan; of another "
                "task read it with h5py, and make Demonstrations.from_episodes of it"
            )
        raise ValueError(f"{source}: expected a demonstrations .npz file, found {found}") from None
    with archive:
        if "format_version.npy" not in archive.namelist():
            expected = "an entry, as Demonstrations.save writes it (for arrays: Demonstrations.from_episodes)"
            found = f"only {', '.join(archive.namelist()) or 'none'}"
            if {"obs.npy", "acts.npy"} <= set(archive.namelist()):
                found += f": {FROM_IMITATION}"
            raise field_error(source, "format_version", expected, found)
        version = _read_array(archive, "format_version", source)
        if version.shape != () or version.dtype.kind not in "iu" or version < 1:
            found = f"type {version.dtype}, shape {version.shape}" if version.shape else repr(version.item())
            raise field_error(source, "format_version", "a whole number of at least 1", found)
        if version > FORMAT_VERSION:
            raise field_error(source, "format_version", f"at most {FORMAT_VERSION} (update sb3-actpc)", str(version))
        return {name: _read_array(archive, name, source) for name in (*_ARRAYS, "dense_rewards", *_NEXT, *_TEXTS)}


def _read_array(archive: zipfile.ZipFile, name: str, source: str) -> np.ndarray:
    if f"{name}.npy" not in archive.namelist():
        raise field_error(source, name, f"an entry {name}.npy", f"only {', '.join(archive.namelist()) or 'none'}")
    try:
        return np.lib.format.read_array(io.BytesIO(archive.read(f"{name}.npy")), allow_pickle=False)
    except Exception as error:  # the readers of zip, deflate and npy have a dozen kinds
        raise field_error(source, name, "a readable array", f"{type(error).__name__}: {str(error)[:200]}") from None


def _read_json(array: np.ndarray, name: str, source: str) -> Any:
    try:
        if array.shape == () and array.dtype.kind == "U":
            return json.loads(array.item())
    except json.JSONDecodeError as error:
        raise field_error(source, name, "JSON text", f"{array.item()[:60]!r} ({error})") from None
    raise field_error(source, name, "JSON text", f"type {array.dtype}, shape {array.shape}")


def _rebuild_next_observations(stored: dict[str, np.ndarray], source: str) -> np.ndarray:
    """Next observations, (N, obs_dim): the following rows, except where others are stored."""
    for name, kinds, n_dims, shape in _FORMS:
        array = stored[name]
        if array.dtype.kind not in kinds or array.ndim != n_dims or array.size == 0:
            expected = f"{'floats' if kinds == 'f' else 'whole numbers'} of shape ({shape})"
            raise field_error(source, name, expected, f"type {array.dtype}, shape {array.shape}")
    observations, starts = stored["observations"], stored["episode_starts"].astype(np.int64)
    indices, rows = stored[_NEXT[0]].astype(np.int64), stored[_NEXT[1]]
    last = np.append(starts[1:], len(observations)) - 1
    is_within = np.all(np.diff(indices) > 0) and indices[0] >= 0 and indices[-1] < len(observations)
    if not is_within or not np.isin(last, indices).all():
        expected = f"increasing indices below {len(observations)} that include the end of every episode"
        raise field_error(source, "next_observation_indices", expected, f"{len(indices)} indices that do not")
    if rows.shape != (len(indices), observations.shape[1]) or rows.dtype != observations.dtype:
        expected = f"shape {(len(indices), observations.shape[1])} of {observations.dtype}"
        raise field_error(source, "next_observation_rows", expected, f"shape {rows.shape} of {rows.dtype}")
    next_observations = np.empty_like(observations)
    next_observations[:-1] = observations[1:]
    next_observations[indices] = rows
    return next_observations
