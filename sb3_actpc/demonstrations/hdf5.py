"""Opening other projects' HDF5 files so that every mistake in them is named: file, demonstration, key."""

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sb3_actpc.utils.extras import import_extra

# of robosuite's OSC_POSE: an action of 1 moves the gripper by 5 cm, or turns it by 0.5 rad
ACTION_SCALES = {
    "input_max": 1.0,
    "input_min": -1.0,
    "output_max": [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],
    "output_min": [-0.05, -0.05, -0.05, -0.5, -0.5, -0.5],
}
# what h5py raises on bytes that are not there, or not HDF5's
_READ_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError)


@contextmanager
def open_hdf5(path: str | os.PathLike[str]) -> Iterator[Any]:
    """Open a file for reading; gives its ``data`` group, an ``h5py.Group``. FileNotFoundError when there is no such file,
    ValueError when it is not a whole HDF5 file or has no demonstrations, ImportError when h5py is not installed."""
    h5py = import_extra("h5py", "robosuite")
    if not Path(path).is_file():
        raise FileNotFoundError(f"no demonstrations file at {path}")
    try:
        file = h5py.File(path, "r")
    except _READ_ERRORS as error:
        raise ValueError(f"{path}: expected a whole HDF5 file, found {Path(path).stat().st_size} bytes ({error})") from None
    with file:
        try:
            data = file["data"]
            names = demo_names(data)
        except _READ_ERRORS as error:
            raise ValueError(f"{path}: expected a group 'data' of demonstrations ({error})") from None
        if not names:
            raise ValueError(f"{path}: expected demonstrations data/demo_0, data/demo_1, ..., found none")
        yield data


def demo_names(data: Any) -> list[str]:
    """The demonstrations of a group, sorted by the numbers in their names (``demo_2`` before ``demo_10``): every group called
    ``demo_<number>``, and every other group that holds ``actions``."""
    names = [name for name in data if re.fullmatch(r"demo_\d+", name) or "actions" in _members(data, name)]
    return sorted(names, key=lambda name: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)])


def mask_names(data: Any, key: str, source: str) -> list[str]:
    """The demonstrations that robomimic's ``mask/<key>`` lists, each once, sorted as by :func:`demo_names`. ValueError when
    the file has no such mask, or it lists anything else."""
    masks = data.file.get("mask", {})
    if key not in masks:
        known = ", ".join(sorted(masks)) or "none, the file has no masks"
        raise ValueError(f"{source}: no mask {key!r}: choose one of {known}")
    try:
        listed = np.asarray(masks[key][()]).ravel().tolist()
    except _READ_ERRORS as error:
        raise ValueError(f"{source}: mask {key!r} cannot be read ({error})") from None
    texts = [name.decode() if isinstance(name, bytes) else str(name) for name in listed]
    names = {text.strip(" \t\n\0") for text in texts} - {""}  # fixed-width texts are padded
    known_names = demo_names(data)
    unknown = sorted(names - set(known_names))
    if unknown or not names:
        raise ValueError(f"{source}: mask {key!r} must name demonstrations, found {', '.join(unknown) or 'none'}")
    return [name for name in known_names if name in names]


def _members(data: Any, name: str) -> Any:
    """What a member of an ``h5py.Group`` holds, if it is a group."""
    return data[name] if hasattr(data[name], "keys") else ()


def read_array(group: Any, key: str, source: str, size: int | None = None, length: int | None = None) -> np.ndarray:
    """A dataset of an ``h5py.Group``, (length, size) float64, or (length,) for a column; a length of None is any of at least
    1. ValueError when it is missing, cannot be read, has another shape or type, or holds NaN or infinity."""
    if key not in group:
        raise ValueError(f"{source}: key {key!r} is missing, only {', '.join(sorted(group)) or 'nothing'} is there")
    try:
        values = np.asarray(group[key][()])
    except _READ_ERRORS as error:
        raise ValueError(f"{source}: key {key!r} cannot be read ({error})") from None
    if values.dtype.kind not in "biuf":
        raise ValueError(f"{source}: key {key!r} must hold numbers, found type {values.dtype}")
    columns = () if size is None else (size,)
    expected = (max(1, len(values)) if length is None else length, *columns) if values.ndim else None
    if values.shape != expected:
        shape = ", ".join(str(n) for n in ("N" if length is None else length, *columns))
        raise ValueError(f"{source}: key {key!r} must have the shape ({shape}), found {values.shape}")
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        index = tuple(bad[0].tolist())
        raise ValueError(f"{source}: key {key!r} must be finite, found {values[index]} at index {index}")
    return values.astype(np.float64)


def read_json_attribute(data: Any, name: str, source: str) -> dict[str, Any]:
    """An attribute of an ``h5py.Group`` with a JSON dictionary; ValueError when it is missing or not JSON."""
    try:
        value = json.loads(data.attrs[name])
    except KeyError:
        raise ValueError(f"{source}: attribute {name!r} of 'data' is missing, which says what was recorded") from None
    except (TypeError, ValueError, OSError) as error:
        raise ValueError(f"{source}: attribute {name!r} of 'data' is not JSON ({error})") from None
    if not isinstance(value, dict):
        raise ValueError(f"{source}: attribute {name!r} of 'data' must be a dictionary, found {value!r}")
    return value


def check_recorded_task(recorded: dict[str, Any], name: str, source: str) -> None:
    """Check the task (robosuite's ``name``), robot, controller and the units of its actions among robosuite's recorded
    keywords; ValueError names the first one that differs."""
    robots = recorded.get("robots", "Panda")
    controller = recorded.get("controller_configs") or {}
    parts = controller.get("body_parts", {})
    arm = parts.get("right", parts.get("arms", {}).get("right", controller))
    found = {
        "env_name": recorded.get("env_name"),
        "robots": robots[0] if isinstance(robots, list) and len(robots) == 1 else robots,
        "controller": arm.get("type", "OSC_POSE"),
        "control_freq": recorded.get("control_freq", 20),
        # absolute poses are not what the environment takes
        "input_type": arm.get("input_type", "delta" if arm.get("control_delta", True) else "absolute"),
    }
    expected = {"env_name": name, "robots": "Panda", "controller": "OSC_POSE", "control_freq": 20, "input_type": "delta"}
    for key, value in expected.items():
        if found[key] != value:
            raise ValueError(f"{source}: expected demonstrations with {key} = {value!r}, found {found[key]!r}: another task")
    for key, value in ACTION_SCALES.items():
        if key in arm and not _is_near(arm[key], value):
            raise ValueError(f"{source}: expected actions with {key} = {value}, found {arm[key]!r}: actions of other units")


def _is_near(found: Any, expected: Any) -> bool:
    """Whether a number, or a list of six, is this one."""
    try:
        return bool(np.allclose(np.asarray(found, dtype=np.float64), expected))
    except (TypeError, ValueError):
        return False
