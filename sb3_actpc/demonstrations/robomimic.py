"""robomimic's HDF5 files of low-dimensional observations (Mandlekar et al., arXiv 2108.03298), fetched, read and written.

Layout: ``data`` (attribute ``env_args``, JSON), ``data/demo_i/{actions,rewards,dones}``, ``data/demo_i/{obs,next_obs}/<key>``,
and ``mask/<filter key>``, the names of some of the demonstrations.
"""

import io
import json
import os
import warnings
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from sb3_actpc.demonstrations import hdf5
from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.recording import Columns, Report, silent
from sb3_actpc.demonstrations.rows import ACTION_TOLERANCE
from sb3_actpc.envs.robosuite_layouts import ACTION_DIM, OBSERVATIONS, PROPRIOCEPTION, RobosuiteTask, robosuite_task
from sb3_actpc.utils.extras import import_extra
from sb3_actpc.utils.files import atomic_write

REPOSITORY = "https://huggingface.co/datasets/robomimic/robomimic_datasets/resolve/main"
KINDS = ("mh", "ph")  # 300 by six humans of three levels, 200 by one proficient human
TIMEOUT_SECONDS = 30.0
ROBOSUITE_TYPE = 1  # robomimic's EnvType
ROBOSUITE_VERSION = "1.5.2"  # whose observations and controller these are
# metres: the median over an episode of how much an object's two recorded distances from the gripper differ
OBJECT_TOLERANCE = 0.005
SUCCESS_LAG = 2  # steps between the recorded and the observed success; robosuite's observations lag behind by up to one


def read_robomimic(
    path: str | os.PathLike[str], env_id: str, obs: str = "paper", filter_key: str | None = None
) -> Demonstrations:
    """Read a robomimic file.

    Episodes end where they first succeed, as they do in the environment. Rewards that are missing or not 0 and 1 are
    computed from the observed object (the latter are kept as dense rewards), and so are rewards that are 0 throughout an
    episode that succeeds by its observations. Warns of that, and where rewards and observations disagree by more than
    ``SUCCESS_LAG`` steps. The object's state is built from its recorded
    pose as the environment builds it, whether robosuite 1.4 or 1.5 recorded it. Where the file has no ``next_obs``, the last
    observation of an episode follows itself.

    :param path: the file
    :param env_id: the task it must be of, ``SparseLift-v0`` or ``SparsePickPlaceCan-v0``
    :param obs: the observations to build, ``"paper"`` or ``"robomimic"``
    :param filter_key: read only the demonstrations under ``mask/<filter_key>``, such as ``"better"`` or ``"20_percent"``
    :return: the demonstrations
    :raises FileNotFoundError: when there is no such file
    :raises ValueError: when the file is cut short, of another task, or a demonstration lacks a key or holds a wrong one; the
        message names the file, the demonstration and the key
    :raises ImportError: when h5py is not installed
    """
    task, source = robosuite_task(env_id), str(path)
    task.layout(obs)
    with hdf5.open_hdf5(path) as data:
        arguments = hdf5.read_json_attribute(data, "env_args", source)
        hdf5.check_recorded_task(
            {**(arguments.get("env_kwargs") or {}), "env_name": arguments.get("env_name")}, task.name, source
        )
        names = hdf5.demo_names(data) if filter_key is None else hdf5.mask_names(data, filter_key, source)
        episodes = [_read_episode(data[name], task, obs, f"{source}: {name}") for name in names]
    metadata = {"source": "robomimic", "env_version": str(arguments.get("env_version", "unknown")), "demos": names}
    if filter_key is not None:
        metadata["filter_key"] = filter_key
    return Demonstrations.from_episodes(episodes, env_id, metadata, source)


def write_robomimic(demonstrations: Demonstrations, path: str | os.PathLike[str]) -> None:
    """Write demonstrations of ``SparseLift-v0`` or ``SparsePickPlaceCan-v0``, with one of their ``obs``, as robomimic stores
    them, all at once or not at all. The filter keys of a mixed set (``metadata["filter_keys"]``) become masks. ValueError when
    they are of another task or layout, ImportError when h5py is not installed."""
    h5py = import_extra("h5py", "robosuite")
    task = robosuite_task(demonstrations.env_id)
    layout = task.layout(task.obs_of_size(demonstrations.observations.shape[1]))
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = len(demonstrations)
        data.attrs["env_args"] = json.dumps(_env_args(task))
        masks: dict[str, list[str]] = defaultdict(list)
        filter_keys = [*demonstrations.metadata.get("filter_keys", []), *[()] * demonstrations.n_episodes]
        for index, (start, end) in enumerate(demonstrations.episode_bounds):
            _write_episode(data.create_group(f"demo_{index}"), demonstrations, slice(start, end), layout)
            for key in filter_keys[index]:
                masks[key].append(f"demo_{index}")
        for key, members in masks.items():
            file.create_dataset(f"mask/{key}", data=np.array(members, dtype="S"))
    with atomic_write(path) as target:
        target.write(content.getvalue())


def robomimic_url(env_id: str, kind: str = "mh") -> str:
    """Address of a file of low-dimensional observations of a robosuite task and a key of ``KINDS`` (MIT licence; 30 to 130
    MB)."""
    folder = {"Lift": "lift", "PickPlaceCan": "can"}[robosuite_task(env_id).name]
    if kind not in KINDS:
        raise ValueError(f"kind={kind!r} is not one of {', '.join(KINDS)}: choose one of these")
    return f"{REPOSITORY}/v1.5/{folder}/{kind}/low_dim_v15.hdf5"


def download_robomimic(
    env_id: str, path: str | os.PathLike[str], url: str, obs: str = "paper", report: Report = silent
) -> Demonstrations:
    """Download a robomimic file (http or https) to a path, unless it is there already, and read it, see
    :func:`~sb3_actpc.demonstrations.read_robomimic`. The file stays under its name only when it is whole and of the task.
    OSError when it cannot be fetched, ValueError when what arrived, or was there, is not such a file, ImportError when h5py is
    not installed."""
    import_extra("h5py", "robosuite")  # before the long part
    path = Path(path)
    if not url.startswith(("http://", "https://")):
        raise ValueError(f"url={url!r} must begin with http:// or https://")
    is_there = path.is_file()
    if is_there:
        report(f"{path} is there already")
    else:
        _fetch(url, path, env_id, report)
    try:
        return read_robomimic(path, env_id, obs)
    except ValueError as error:
        if is_there:
            raise ValueError(f"{error}; it was there already: delete it, and it is downloaded") from None
        path.unlink()  # the next try would take it for a good one
        raise ValueError(f"{error}; what {url} gave was deleted: give the --url of a file of {env_id}") from None


def _fetch(url: str, path: Path, env_id: str, report: Report) -> None:
    pooch = import_extra("pooch", "experiments")

    report(f"fetching {url}")
    pooch.get_logger().setLevel("WARNING")
    try:
        downloader = pooch.HTTPDownloader(timeout=TIMEOUT_SECONDS)
        pooch.retrieve(url, known_hash=None, fname=path.name, path=path.parent, downloader=downloader)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise OSError(
            f"could not fetch {url}: where there is a network, download that address, then make demonstrations of the file "
            f"here with `sb3-actpc demos convert FILE --env {env_id}` ({reason})"
        ) from None
    report(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")


def _read_episode(group: Any, task: RobosuiteTask, obs: str, source: str) -> Columns:
    actions = hdf5.read_array(group, "actions", source, size=ACTION_DIM)
    length = len(actions)
    too_large = np.argwhere(np.abs(actions) > 1.0 + ACTION_TOLERANCE)
    if len(too_large):
        index = tuple(too_large[0].tolist())
        raise ValueError(f"{source}: key 'actions' must lie in [-1, 1], found {actions[index]} at index {index}")
    parts = _read_parts(group, "obs", task, obs, length, source)
    if "next_obs" in group:
        next_parts = _read_parts(group, "next_obs", task, obs, length, source)
    else:
        next_parts = {name: np.concatenate([part[1:], part[-1:]]) for name, part in parts.items()}
    successes = task.is_success(next_parts["object"], next_parts["robot0_eef_pos"])
    recorded = hdf5.read_array(group, "rewards", source, length=length) if "rewards" in group else None
    is_sparse = recorded is not None and bool(np.isin(recorded, (0.0, 1.0)).all())
    rewards = successes.astype(np.float64)
    if recorded is not None and is_sparse and _is_trusted(recorded, successes, "next_obs" in group, source):
        rewards = recorded
    end = int(np.argmax(rewards)) + 1 if rewards.any() else length
    columns = {
        "observations": np.concatenate([parts[name] for name in OBSERVATIONS[obs]], axis=1),
        "actions": actions,
        "next_observations": np.concatenate([next_parts[name] for name in OBSERVATIONS[obs]], axis=1),
        "rewards": rewards,
        "terminations": rewards > 0.0,
    }
    if recorded is not None and not is_sparse:
        columns["dense_rewards"] = recorded
    return {name: column[:end] for name, column in columns.items()}


def _is_trusted(recorded: np.ndarray, successes: np.ndarray, sees_end: bool, source: str) -> bool:
    """Whether recorded rewards (N,) of 0 and 1 are taken, not the observed successes (N,); warns when they disagree. The state
    after the last action is not always observed (``sees_end``)."""
    first, observed = int(np.argmax(recorded)), int(np.argmax(successes))
    problem = ""
    if not recorded.any() and successes.any():
        problem = f"is 0 throughout, the object is observed in place at step {observed}: the observations are taken"
    elif recorded.any() and not successes.any() and (sees_end or first < len(recorded) - 1):
        problem = "has a success, the observed object none: check the file"
    elif successes.any() and abs(first - observed) > SUCCESS_LAG:
        problem = f"has its first success at step {first}, the observed object at step {observed}: check the file"
    if problem:
        warnings.warn(f"{source}: key 'rewards' {problem}", stacklevel=2)
    return bool(recorded.any() or not successes.any())


def _read_parts(group: Any, kind: str, task: RobosuiteTask, obs: str, length: int, source: str) -> dict[str, np.ndarray]:
    """Every part of the observations, (length, size), in the order of robosuite 1.5."""
    sizes = {**PROPRIOCEPTION, "object": task.object_dim}
    if kind not in group:
        raise ValueError(f"{source}: key {kind!r} is missing, only {', '.join(sorted(group)) or 'nothing'} is there")
    parts = {}
    for name in OBSERVATIONS[obs]:
        try:
            parts[name] = hdf5.read_array(group[kind], name, f"{source}: {kind}", sizes[name], length)
        except ValueError as error:
            hint = "" if name in OBSERVATIONS["robomimic"] or name in group[kind] else " (obs='robomimic' needs fewer keys)"
            raise ValueError(f"{error}{hint}") from None
    gripper = parts["robot0_eef_pos"], parts["robot0_eef_quat"]
    parts["object"] = _object_states(parts["object"], *gripper, task, f"{source}: {kind}")
    return parts


def _object_states(
    recorded: np.ndarray, eef_positions: np.ndarray, eef_quats: np.ndarray, task: RobosuiteTask, source: str
) -> np.ndarray:
    """The object's states, (N, object_dim), as the environment gives them.

    The recorded ones may be in the order of robosuite 1.4 (Lift: the offset has the other sign; can: the absolute pose comes
    first), and in robosuite 1.5 the can's pose in the gripper's frame lags behind by one step: only the absolute pose is
    taken, and the order is that in which the distances to the gripper agree.
    """
    columns = task.object_columns()
    orders = [recorded] if task.name == "Lift" else [recorded, np.concatenate([recorded[:, 7:], recorded[:, :7]], axis=1)]
    errors = []
    for states in orders:
        distances = np.linalg.norm(states[:, columns["pos"]] - eef_positions, axis=1)
        errors.append(np.median(np.abs(distances - np.linalg.norm(states[:, columns["to_eef_pos"]], axis=1))))
    best = int(np.argmin(errors))
    if errors[best] > OBJECT_TOLERANCE:
        raise ValueError(
            f"{source}: key 'object' must hold the object's {', '.join(columns)} in the order of robosuite 1.4 or 1.5, found "
            f"numbers that do not agree with robot0_eef_pos (by {errors[best]:.3f} m)"
        )
    states = orders[best]
    return task.object_states(states[:, columns["pos"]], states[:, columns["quat"]], eef_positions, eef_quats)


def _env_args(task: RobosuiteTask) -> dict[str, Any]:
    arm: dict[str, Any] = {"type": "OSC_POSE", "input_type": "delta", "input_ref_frame": "base"}
    arm |= {**hdf5.ACTION_SCALES, "kp": 150, "damping_ratio": 1}
    arm |= {"impedance_mode": "fixed", "kp_limits": [0, 300], "damping_ratio_limits": [0, 10], "gripper": {"type": "GRIP"}}
    controller = {"type": "BASIC", "body_parts": {"right": {**arm, "uncouple_pos_ori": True, "ramp_ratio": 0.2}}}
    kwargs = {"robots": ["Panda"], "controller_configs": controller, "control_freq": 20, "reward_shaping": False}
    return {"env_name": task.name, "env_version": ROBOSUITE_VERSION, "type": ROBOSUITE_TYPE, "env_kwargs": kwargs}


def _write_episode(group: Any, demonstrations: Demonstrations, rows: slice, layout: dict[str, slice]) -> None:
    group.attrs["num_samples"] = rows.stop - rows.start
    group["actions"] = demonstrations.actions[rows]
    group["rewards"] = demonstrations.rewards[rows]
    group["dones"] = demonstrations.terminations[rows].astype(np.int64)
    for part, columns in layout.items():
        group[f"obs/{part}"] = demonstrations.observations[rows, columns]
        group[f"next_obs/{part}"] = demonstrations.next_observations[rows, columns]
