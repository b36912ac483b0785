"""Gymnasium's MuJoCo tasks with sparse rewards.

The tasks are those of Ororbia & Mali (arXiv 2209.09174). The Reacher's reward is 1 near its target. The locomotion tasks
have two conditions. ``"displacement"``, the published benchmark of LOGO (Rengarajan et al., arXiv 2202.04628), rewards a
distance travelled. ``"forward"``, the wording of the paper's appendix, rewards a forward velocity.

The position along x is not observed, so the reward of ``"displacement"`` is no function of the observation; the reward of
``"forward"`` nearly is.

Every class is the base task with another reward: observations, actions, dynamics, falls, rendering and the base task's
keywords are unchanged. The base task's reward is ``info["dense_reward"]``. Time limits are set by
:func:`sb3_actpc.envs.register_envs`, and reported as truncation.
"""

from __future__ import annotations

import inspect
import math
from numbers import Real
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import utils
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.registration import load_env_creator

from sb3_actpc.envs import SPARSE_MUJOCO_IDS

if TYPE_CHECKING:
    from sb3_actpc.demonstrations.dataset import Demonstrations

LOCOMOTION_CONDITIONS: tuple[str, ...] = ("displacement", "forward")


def _check_number(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    """ValueError for anything but a finite number of at least ``low`` and below ``high``."""
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value) or not low <= float(value) < high:
        raise ValueError(f"{name}={value!r} must be a finite number, at least {low} and below {high}")
    return float(value)


class _SparseMujocoEnv(MujocoEnv, utils.EzPickle):
    """A base task whose reward is moved to ``info["dense_reward"]`` and replaced by a sparse one."""

    # the base class promises NumPy floats; the reward here is a Python float
    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        """Advance the base task by one step with an action (action_dim,): observation (obs_dim,), sparse reward, terminated (a
        fall), truncated, info with ``dense_reward`` (float) and ``is_success`` (bool)."""
        observation, dense_reward, terminated, truncated, base_info = super().step(action)
        info: dict[str, Any] = dict(base_info)
        reward, is_success = self._sparse_reward(info)
        info.update(dense_reward=float(dense_reward), is_success=is_success)
        return observation, reward, bool(terminated), truncated, info

    def _sparse_reward(self, info: dict[str, Any]) -> tuple[float, bool]:
        """Sparse reward and success of the state just reached."""
        raise NotImplementedError


class SparseReacherEnv(_SparseMujocoEnv):
    """Reward 1 while the fingertip is near the target.

    ``info["is_success"]`` is whether the present step has reward 1, so at the end of an episode, whether its last step had.

    :param threshold: distance in metres at or below which the reward is 1
    :param miss_reward: reward of every other step, 0 by default; baselines are often given -1
    :param kwargs: the base task's keywords
    :raises ValueError: for a negative threshold, or a ``miss_reward`` of 1 or more
    """

    def __init__(self, threshold: float = 0.06, miss_reward: float = 0.0, **kwargs: Any) -> None:
        self.threshold = _check_number("threshold", threshold, low=0.0)
        self.miss_reward = _check_number("miss_reward", miss_reward, high=1.0)
        super().__init__(**kwargs)
        utils.EzPickle.__init__(self, threshold=threshold, miss_reward=miss_reward, **kwargs)

    def demonstrated_rewards(self, demonstrations: Demonstrations) -> np.ndarray:
        """The rewards that this environment gives for N recorded transitions, (N,) float32, from the distance to the target,
        which is observed; as recorded where a wrapper shows something else."""
        if demonstrations.next_observations.shape[1:] != self.observation_space.shape:
            return demonstrations.rewards
        distances = np.linalg.norm(demonstrations.next_observations[:, 8:], axis=1)  # fingertip minus target
        return np.where(distances <= self.threshold, 1.0, self.miss_reward).astype(np.float32)

    def _sparse_reward(self, info: dict[str, Any]) -> tuple[float, bool]:
        distance = np.linalg.norm(self.get_body_com("fingertip") - self.get_body_com("target"))
        is_near = bool(distance <= self.threshold)
        return (1.0 if is_near else self.miss_reward), is_near


class SparseLocomotionEnv(_SparseMujocoEnv):
    """Reward 1 for having come far enough, or for moving forward fast enough, else 0.

    ``info["is_success"]`` is whether the distance of the ``"displacement"`` condition has been passed in this episode,
    under either condition.

    :param condition: ``"displacement"`` rewards every step at which x - x_0 exceeds the threshold, x_0 being x after
        the reset; ``"forward"`` rewards every step whose mean forward velocity exceeds it
    :param threshold: metres or metres per second, None for the task's own; with ``"forward"`` and 0 any forward motion is
        rewarded, the paper's wording for Walker2d, Hopper and Swimmer
    :param kwargs: the base task's keywords
    :raises ValueError: for an unknown condition, or a negative threshold
    """

    # the task's own, and the base reward's default weights: forward, control cost, health
    default_distance: ClassVar[float]
    default_velocity: ClassVar[float]
    reward_weights: ClassVar[dict[str, float]]

    def __init__(self, condition: str = "displacement", threshold: float | None = None, **kwargs: Any) -> None:
        if condition not in LOCOMOTION_CONDITIONS:
            raise ValueError(f"condition={condition!r} is not one of {LOCOMOTION_CONDITIONS}: choose one of these")
        self.condition = condition
        self.distance, self.velocity = self.default_distance, self.default_velocity
        if threshold is not None:
            replaced = "distance" if condition == "displacement" else "velocity"
            setattr(self, replaced, _check_number("threshold", threshold, low=0.0))
        self._start_x = 0.0
        self._has_passed = False
        super().__init__(**kwargs)
        utils.EzPickle.__init__(self, condition=condition, threshold=threshold, **kwargs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode and remember its x; as the base task's."""
        observation, info = super().reset(seed=seed, options=options)
        self._start_x = float(self.data.qpos[0])
        self._has_passed = False
        return observation, info

    def demonstrated_rewards(self, demonstrations: Demonstrations) -> np.ndarray:
        """The rewards that this environment, with its own condition and threshold, gives for N recorded transitions, (N,)
        float32; the recorded ones where ``dense_rewards`` is None."""
        if demonstrations.dense_rewards is None:
            return demonstrations.rewards
        velocities = self.demonstrated_velocities(demonstrations)
        if self.condition == "forward":
            return (velocities > self.velocity).astype(np.float32)
        bounds = demonstrations.episode_bounds
        distances = np.concatenate([np.cumsum(velocities[start:end]) * self.dt for start, end in bounds])
        return (distances > self.distance).astype(np.float32)

    def demonstrated_velocities(self, demonstrations: Demonstrations) -> np.ndarray:
        """Forward velocities in metres per second, (N,) float64: ``dense_rewards`` without control cost and health, weighed by
        default or as here, whichever agrees better with the velocities that are observed."""
        assert self.model is not None and demonstrations.dense_rewards is not None
        efforts = np.square(demonstrations.actions, dtype=np.float64).sum(axis=1)
        # -v4 rewards health also on the step that falls
        is_healthy = ~(demonstrations.terminations & demonstrations.env_id.endswith("v5"))
        candidates = []
        for weights in (self.reward_weights, {name: getattr(self, f"_{name}", 0.0) for name in self.reward_weights}):
            forward, cost, health = weights.values()
            candidates.append((demonstrations.dense_rewards + cost * efforts - health * is_healthy) / forward)
        if demonstrations.next_observations.shape[1:] != self.observation_space.shape:  # a wrapper shows something else
            return candidates[0]
        observed = demonstrations.next_observations[:, -self.model.nv]  # at the end of a step; Hopper and Walker2d clip it
        return min(candidates, key=lambda one: float(np.abs(one - observed).mean()))

    def _sparse_reward(self, info: dict[str, Any]) -> tuple[float, bool]:
        is_far = bool(self.data.qpos[0] - self._start_x > self.distance)
        self._has_passed = self._has_passed or is_far
        is_rewarded = is_far if self.condition == "displacement" else bool(info["x_velocity"] > self.velocity)
        return float(is_rewarded), self._has_passed


# metres, of LOGO's benchmark, and metres per second, our choice: the paper gives none. Of the steps of uniformly random
# actions (10 episodes of -v5) the latter rewards 0 % (HalfCheetah, Walker2d), 4 % (Hopper) and 18 % (Swimmer, which swings)
_DISTANCES = {"HalfCheetah": 20.0, "Walker2d": 2.0, "Hopper": 2.0, "Swimmer": 1.0}
_VELOCITIES = {"HalfCheetah": 3.5, "Walker2d": 1.0, "Hopper": 1.0, "Swimmer": 0.3}


def _sparse_class(env_id: str) -> type:
    """The class of a sparse task, such as ``SparseHopperV5Env``: Gymnasium's own with another reward."""
    task, version = env_id.removeprefix("Sparse").split("-")
    base: Any = load_env_creator(str(gym.spec(f"{task}-{version}").entry_point))
    described = {"__module__": __name__, "__doc__": f"``{task}-{version}`` with a sparse reward."}
    name = f"Sparse{task}{version.upper()}Env"
    if task == "Reacher":
        return type(name, (SparseReacherEnv, base), described)
    arguments = inspect.signature(base.__init__).parameters
    names = ("forward_reward_weight", "ctrl_cost_weight", "healthy_reward")  # HalfCheetah and Swimmer have no health
    weights = {name: arguments[name].default if name in arguments else 0.0 for name in names}
    own = {"default_distance": _DISTANCES[task], "default_velocity": _VELOCITIES[task], "reward_weights": weights}
    return type(name, (SparseLocomotionEnv, base), described | own)


globals().update({made.__name__: made for made in map(_sparse_class, SPARSE_MUJOCO_IDS)})
