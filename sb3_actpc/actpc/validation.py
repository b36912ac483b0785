"""Checks of what environments and buffers bring."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim, get_obs_shape

from sb3_actpc.utils.checks import check_finite
from sb3_actpc.utils.nested import map_observations

LARGEST_BOUND = 1e6  # of an observation; larger ones stand for none


def check_loaded_buffer(path: Any, loaded: Any, is_own: bool, agent: Any) -> None:
    """:raises ValueError: for a buffer of another algorithm, number of environments or shapes"""
    needed = agent.n_envs, get_obs_shape(agent.observation_space), get_action_dim(agent.action_space)
    held = getattr(loaded, "n_envs", None), getattr(loaded, "obs_shape", None), getattr(loaded, "action_dim", None)
    if not is_own or held != needed:
        shapes = "{} environments, observations of {} and {} actions".format
        raise ValueError(f"{path} holds a {type(loaded).__name__} of {shapes(*held)}: this agent is of {shapes(*needed)}")


def check_observations(observations: Any, step: int) -> None:
    """:raises ValueError: for observations that are not finite in float32, which circuits see"""

    def check(array: Any) -> None:
        array = np.asarray(array)  # an environment's last observation may be a number or a list
        with np.errstate(over="ignore"):
            seen = array.astype(np.float32) if array.dtype == np.float64 else array
        check_finite("environment", "observations", seen, step)

    map_observations(check, observations)


def check_step(observations: Any, rewards: np.ndarray, infos: list[dict[str, Any]], step: int) -> None:
    """:raises ValueError: for observations, last ones of episodes among them, or rewards that are not finite"""
    for seen in (observations, *(info["terminal_observation"] for info in infos if "terminal_observation" in info)):
        check_observations(seen, step)
    check_finite("environment", "rewards", rewards, step)


def finite_bounds(observation_space: spaces.Space, is_normalised: bool) -> np.ndarray:
    """
    :return: the lowest and the highest observation, (2, n)
    :raises ValueError: where observations have no bounds, or VecNormalize normalises them already
    """
    space = observation_space
    bounds = np.stack([space.low, space.high]) if isinstance(space, spaces.Box) else np.full(1, np.inf)
    if bounds.ndim != 2 or not np.all(np.abs(bounds.astype(np.float64)) < LARGEST_BOUND) or is_normalised:
        raise ValueError(
            f"observation_normalization='bounds' needs a flat Box whose bounds are below {LARGEST_BOUND:g}, and no "
            f"VecNormalize(norm_obs=True): observation_space={space}"
        )
    return bounds
