"""What the agent asks of its environments: transitions as they were before VecNormalize and resets, and steps made."""

from typing import Any

import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_actpc.actpc.self_imitation import Observations
from sb3_actpc.utils.nested import map_observations


def last_observations(
    observations: Any, dones: np.ndarray, infos: list[dict[str, Any]], env: VecNormalize | None
) -> Observations:
    """
    Next observations before the environments were reset.

    :param observations: (n_envs, *obs_shape), or a dict of such, after the reset and before VecNormalize
    :param dones: (n_envs,), whether the episode ended
    :param infos: with ``terminal_observation`` where it ended, as VecNormalize made it
    :param env: VecNormalize, or None
    :return: a copy, with the last observation of every episode that ended
    """
    copies = map_observations(np.array, observations)
    for index in np.flatnonzero(dones):
        terminal = infos[index].get("terminal_observation")
        if terminal is None:
            continue
        if env is not None:
            terminal = env.unnormalize_obs(terminal)
        if isinstance(copies, dict):
            for key in copies:
                copies[key][index] = terminal[key]
        else:
            copies[index] = terminal
    return copies


def count_steps(env: VecEnv | None) -> list[int] | None:
    """
    Steps that each environment has made, and of these in the running episode; no matter who acted.

    :param env: with SB3's Monitor, which counts them
    :return: (2 * n_envs,), or None where the environments do not tell
    """
    try:
        if env is None or not all(env.env_is_wrapped(Monitor)):
            return None
        return [*env.get_attr("total_steps"), *map(len, env.get_attr("rewards"))]
    except (AttributeError, NotImplementedError, TypeError):
        return None
