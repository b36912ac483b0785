"""What the agent asks of its environments: transitions as they were before VecNormalize and resets."""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

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
