"""HDF5 files of the robosuite tasks: robomimic's, of low-dimensional observations (Mandlekar et al., arXiv 2108.03298),
fetched and read; and robosuite's own ``demo.hdf5``, whose states are observed again.

robomimic's layout: ``data`` (attribute ``env_args``, JSON), ``data/demo_i/{actions,rewards,dones}``,
``data/demo_i/{obs,next_obs}/<key>``, and ``mask/<filter key>``, the names of some of the demonstrations. robosuite's:
``data`` (attribute ``env_info``, JSON), ``data/demo_i/{states,actions}``.
"""

import json
import os
import re
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.recording import Columns, Report, silent
from sb3_actpc.envs.robosuite_layouts import ACTION_DIM, OBSERVATIONS, RobosuiteTask, robosuite_task
from sb3_actpc.utils.extras import import_extra

REPOSITORY = "https://huggingface.co/datasets/robomimic/robomimic_datasets/resolve/main"
TIMEOUT_SECONDS = 30.0
# metres: the median over an episode of how much an object's two recorded distances from the gripper differ
OBJECT_TOLERANCE = 0.005


def read_hdf5(path: str | os.PathLike[str], env_id: str, obs: str = "paper", filter_key: str | None = None) -> Demonstrations:
    """Read a file of robomimic's, or of robosuite's ``collect_human_demonstrations``.

    Episodes end where they first succeed, as they do in the environment. Of robomimic's, rewards that are missing, 0
    throughout, or not 0 and 1 are computed from the observed object (the last are kept as dense rewards). The object's state
    is built from its recorded pose as the environment builds it, whether robosuite 1.4 or 1.5 recorded it. Where the file has
    no ``next_obs``, the last observation of an episode follows itself.

    Of robosuite's, the simulator is put into each recorded state. Actions are clipped to [-1, 1] (a space mouse reaches
    further; the controller clips them too). The last action of an episode that does not succeed is left out: no state follows.

    :param path: the file
    :param env_id: the task it must be of, ``SparseLift-v0`` or ``SparsePickPlaceCan-v0``
    :param obs: the observations to build, ``"paper"`` or ``"robomimic"``
    :param filter_key: read only the demonstrations under robomimic's ``mask/<filter_key>``, such as ``"20_percent"``
    :return: the demonstrations
    :raises FileNotFoundError: when there is no such file
    :raises ValueError: when the file is cut short, of another task, or a demonstration lacks a key or holds a wrong one; the
        message names the file, the demonstration and the key
    :raises ImportError: when h5py, or for robosuite's file robosuite, is not installed
    """
    h5py = import_extra("h5py", "robosuite")
    source = str(path)
    task = robosuite_task(env_id)
    obs_dim = task.obs_dim(obs)
    if not Path(path).is_file():
        raise FileNotFoundError(f"no demonstrations file at {path}")
    try:
        with h5py.File(path, "r") as file:
            is_robomimic = "env_args" in file["data"].attrs
            _check_task(json.loads(file["data"].attrs["env_args" if is_robomimic else "env_info"]), task, source)
            names = _demo_names(file, filter_key, source)
            demos = [file["data"][name] for name in names]
            episodes = [_read_episode(demo, task, obs) for demo in demos] if is_robomimic else _replay(demos, task, obs)
    except (OSError, RuntimeError, KeyError, json.JSONDecodeError) as error:  # of h5py, on bytes that are not there
        raise ValueError(f"{source}: expected a whole HDF5 file of robomimic or robosuite ({error})") from None
    metadata = {"source": "robomimic" if is_robomimic else "robosuite", "demos": names}
    if filter_key is not None:
        metadata["filter_key"] = filter_key
    read = Demonstrations.from_episodes([_until_success(one) for one in episodes], task.env_id, metadata, source)
    read.check(spaces.Box(-np.inf, np.inf, (obs_dim,)), spaces.Box(-1.0, 1.0, (ACTION_DIM,)))
    return read


def download_robomimic(
    env_id: str, path: str | os.PathLike[str], url: str | None = None, obs: str = "paper", report: Report = silent
) -> Demonstrations:
    """Download robomimic's 300 multi-human demonstrations of a task (MIT licence; 30 to 130 MB), or the file at another
    address, to a path, unless it is there already, and read it, see :func:`read_hdf5`. OSError when it cannot be fetched,
    ValueError when what arrived, or was there, is not such a file, ImportError when h5py is not installed."""
    pooch = import_extra("pooch", "experiments")
    import_extra("h5py", "robosuite")  # before the long part
    path = Path(path)
    folder = {"Lift": "lift", "PickPlaceCan": "can"}[robosuite_task(env_id).name]
    url = url or f"{REPOSITORY}/v1.5/{folder}/mh/low_dim_v15.hdf5"
    report(f"fetching {url}, unless it is there, to {path}")
    pooch.get_logger().setLevel("WARNING")
    try:
        downloader = pooch.HTTPDownloader(timeout=TIMEOUT_SECONDS)
        pooch.retrieve(url, known_hash=None, fname=path.name, path=path.parent, downloader=downloader)
    except (OSError, ValueError) as error:
        raise OSError(
            f"could not fetch {url}: where there is a network, download that address, then make demonstrations of the file "
            f"here with `sb3-actpc demos convert FILE --env {env_id}` ({' '.join(str(error).split())})"
        ) from None
    try:
        return read_hdf5(path, env_id, obs)
    except ValueError as error:
        raise ValueError(f"{error}; delete it, and give the --url of a file of {env_id}") from None


def _check_task(recorded: Any, task: RobosuiteTask, source: str) -> None:
    """ValueError names the first of task, robot, controller and the units of its actions that differs among the recorded
    keywords of robosuite."""
    recorded = {**recorded, **(recorded.get("env_kwargs") or {})}
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
    expected = {"env_name": task.name, "robots": "Panda", "controller": "OSC_POSE", "control_freq": 20, "input_type": "delta"}
    for key, value in expected.items():
        if found[key] != value:
            raise ValueError(f"{source}: expected demonstrations with {key} = {value!r}, found {found[key]!r}: another task")


def _demo_names(file: Any, filter_key: str | None, source: str) -> list[str]:
    """The demonstrations, or those that robomimic's mask lists, sorted by their numbers (``demo_2`` before ``demo_10``)."""
    names = sorted((name for name in file["data"] if re.fullmatch(r"demo_\d+", name)), key=lambda name: int(name[5:]))
    if filter_key is not None:
        masks = file.get("mask", {})
        if filter_key not in masks:
            known = ", ".join(sorted(masks)) or "none, the file has no masks"
            raise ValueError(f"{source}: no mask {filter_key!r}: choose one of {known}")
        listed = {name.strip(" \0") for name in masks[filter_key].asstr()[()].ravel()}  # fixed-width texts are padded
        names = [name for name in names if name in listed]
    if not names:
        raise ValueError(f"{source}: expected demonstrations data/demo_0, data/demo_1, ..., found none")
    return names


def _read_array(group: Any, key: str, *shape: int | None) -> np.ndarray:
    """A dataset of an ``h5py.Group`` of this shape (None: any length but 0), float64."""
    where = f"{group.file.filename}: {group.name}/{key}"
    if key not in group:
        raise ValueError(f"{where} is missing, only {', '.join(sorted(group)) or 'nothing'} is there")
    values = np.asarray(group[key])
    fits = [size in (None, found) for found, size in zip(values.shape, shape, strict=False)]
    if values.dtype.kind not in "biuf" or values.ndim != len(shape) or not values.size or not all(fits):
        expected = ", ".join("N" if size is None else str(size) for size in shape)
        raise ValueError(f"{where} must hold numbers of shape ({expected}), found type {values.dtype}, shape {values.shape}")
    return values.astype(np.float64)


def _read_episode(demo: Any, task: RobosuiteTask, obs: str) -> Columns:
    actions = _read_array(demo, "actions", None, ACTION_DIM)
    length = len(actions)
    parts = _read_parts(demo, "obs", task, obs, length)
    next_parts = {name: np.concatenate([part[1:], part[-1:]]) for name, part in parts.items()}
    if "next_obs" in demo:
        next_parts = _read_parts(demo, "next_obs", task, obs, length)
    rewards = task.is_success(next_parts["object"], next_parts["robot0_eef_pos"]).astype(np.float64)
    columns = {}
    if "rewards" in demo:
        recorded = _read_array(demo, "rewards", length)
        if not np.isin(recorded, (0.0, 1.0)).all():
            columns["dense_rewards"] = recorded
        elif recorded.any():
            rewards = recorded
    return {
        "observations": np.concatenate([parts[name] for name in OBSERVATIONS[obs]], axis=1),
        "actions": actions,
        "next_observations": np.concatenate([next_parts[name] for name in OBSERVATIONS[obs]], axis=1),
        "rewards": rewards,
        **columns,
    }


def _read_parts(demo: Any, kind: str, task: RobosuiteTask, obs: str, length: int) -> dict[str, np.ndarray]:
    """Every part of the observations, (length, size), in the order of robosuite 1.5."""
    parts = {name: _read_array(demo, f"{kind}/{name}", length, task.part_sizes()[name]) for name in OBSERVATIONS[obs]}
    where = f"{demo.file.filename}: {demo.name}/{kind}/object"
    parts["object"] = _object_states(parts["object"], parts["robot0_eef_pos"], parts["robot0_eef_quat"], task, where)
    return parts


def _object_states(
    recorded: np.ndarray, eef_positions: np.ndarray, eef_quats: np.ndarray, task: RobosuiteTask, where: str
) -> np.ndarray:
    """The object's states, (N, object_dim), as the environment gives them.

    The recorded ones may be in the order of robosuite 1.4 (Lift: the offset has the other sign; can: the absolute pose comes
    first), and in robosuite 1.5 the can's pose in the gripper's frame lags behind by one step: only the absolute pose is
    taken, and the order is that in which the distances to the gripper agree.
    """
    columns = task.object_columns()
    orders = [recorded] if task.name == "Lift" else [recorded, np.roll(recorded, 7, axis=1)]
    errors = []
    for states in orders:
        distances = np.linalg.norm(states[:, columns["pos"]] - eef_positions, axis=1)
        errors.append(np.median(np.abs(distances - np.linalg.norm(states[:, columns["to_eef_pos"]], axis=1))))
    best = int(np.argmin(errors))
    if errors[best] > OBJECT_TOLERANCE:
        raise ValueError(f"{where} must hold {', '.join(columns)}, as robosuite 1.4 or 1.5 has them: the distances differ")
    states = orders[best]
    return task.object_states(states[:, columns["pos"]], states[:, columns["quat"]], eef_positions, eef_quats)


def _replay(demos: list[Any], task: RobosuiteTask, obs: str) -> list[Columns]:
    """The episodes of robosuite's own file."""
    episodes = []
    with closing(gym.make(task.env_id, obs=obs)) as env:
        env.reset(seed=0)
        simulator: Any = env.unwrapped
        layout = task.layout(obs)
        for demo in demos:
            actions = _read_array(demo, "actions", None, ACTION_DIM)
            states = _read_array(demo, "states", len(actions), 1 + simulator.model.nq + simulator.model.nv)
            rows = np.stack([simulator.observe_state(state) for state in states])
            episodes.append(
                {
                    "observations": rows[:-1],
                    "actions": np.clip(actions[:-1], -1.0, 1.0),
                    "next_observations": rows[1:],
                    "rewards": task.is_success(rows[1:, layout["object"]], rows[1:, layout["robot0_eef_pos"]]),
                }
            )
    return episodes


def _until_success(episode: Columns) -> Columns:
    """The columns up to the first success, which ends the episode."""
    rewards = episode["rewards"]
    end = int(np.argmax(rewards)) + 1 if rewards.any() else len(rewards)
    return {name: column[:end] for name, column in {**episode, "terminations": rewards > 0.0}.items()}
