"""robosuite's own ``demo.hdf5``: recorded simulator states and actions, from which the observations are made again."""

import os
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.hdf5 import check_recorded_task, demo_names, open_hdf5, read_array, read_json_attribute
from sb3_actpc.demonstrations.recording import Columns
from sb3_actpc.envs.robosuite_layouts import ACTION_DIM, RobosuiteTask, robosuite_task


def read_robosuite(path: str | os.PathLike[str], env_id: str, obs: str = "paper") -> Demonstrations:
    """Read a file of robosuite's ``collect_human_demonstrations`` by putting the simulator into each recorded state.

    Actions are clipped to [-1, 1] (a space mouse reaches further; the controller clips them too). Episodes end where they
    first succeed. The last action of an episode that does not succeed is left out: no state follows it.

    :param path: the file: ``data`` (attributes ``env`` and ``env_info``), ``data/demo_i/{states,actions}``
    :param env_id: the task it must be of, ``SparseLift-v0`` or ``SparsePickPlaceCan-v0``
    :param obs: the environment's ``obs``
    :raises ImportError: when robosuite or h5py is not installed; for other errors see
        :func:`~sb3_actpc.demonstrations.read_robomimic`
    """
    task, source = robosuite_task(env_id), str(path)
    with open_hdf5(path) as data:
        recorded = read_json_attribute(data, "env_info", source)
        check_recorded_task(recorded, task.name, source)
        env = gym.make(env_id, obs=obs)
        try:
            env.reset(seed=0)
            names = demo_names(data)
            episodes = [_replay(data[name], env.unwrapped, task, obs, f"{source}: {name}") for name in names]
        finally:
            env.close()
        version = str(data.attrs.get("repository_version", "unknown"))
    metadata = {"source": "robosuite", "repository_version": version, "demos": names}
    return Demonstrations.from_episodes(episodes, env_id, metadata, source)


def _replay(group: Any, env: Any, task: RobosuiteTask, obs: str, source: str) -> Columns:
    actions = read_array(group, "actions", source, size=ACTION_DIM)
    states = read_array(group, "states", source, size=1 + env.model.nq + env.model.nv, length=len(actions))
    if len(states) < 2:
        raise ValueError(f"{source}: key 'states' must have at least 2 rows, found {len(states)}")
    observations = np.stack([env.observe_state(state) for state in states])
    layout = task.layout(obs)
    rewards = task.is_success(observations[1:, layout["object"]], observations[1:, layout["robot0_eef_pos"]])
    end = int(np.argmax(rewards)) + 1 if rewards.any() else len(rewards)
    return {
        "observations": observations[:end],
        "actions": np.clip(actions[:end], -1.0, 1.0),
        "next_observations": observations[1 : end + 1],
        "rewards": rewards[:end].astype(np.float32),
        "terminations": rewards[:end],
    }
