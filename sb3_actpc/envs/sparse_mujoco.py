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
_NUMBERS = (int, float, np.integer, np.floating)


def _check_threshold(threshold: float | None, default: float, meaning: str, *, allow_zero: bool = False) -> float:
    """The threshold in use; ValueError if it is not a positive finite number, or with ``allow_zero`` 0."""
    if threshold is None:
        return default
    is_number = isinstance(threshold, _NUMBERS) and not isinstance(threshold, bool)
    if not is_number or not (0.0 < threshold < math.inf or (allow_zero and threshold == 0.0)):
        kind = "finite number of at least 0" if allow_zero else "positive finite number"
        raise ValueError(f"threshold={threshold!r} must be a {kind} ({meaning}): give one, or None for {default}")
    return float(threshold)


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

    def demonstrated_rewards(self, demonstrations: Demonstrations) -> np.ndarray:
        """The rewards that this environment, with its own condition and threshold, gives for N recorded transitions of the
        same task, under any condition: (N,) float32; the recorded ones where they cannot be computed."""
        raise NotImplementedError

    def demonstrated_positions(self, demonstrations: Demonstrations) -> np.ndarray:
        """Generalised positions after every recorded transition, (N, nq) float64, to draw the demonstrator with."""
        raise NotImplementedError

    def _sparse_reward(self, info: dict[str, Any]) -> tuple[float, bool]:
        """Sparse reward and success of the state just reached."""
        raise NotImplementedError


class SparseReacherEnv(_SparseMujocoEnv):
    """Reward 1 while the fingertip is near the target.

    ``info["is_success"]`` is whether the present step has reward 1, so at the end of an episode, whether its last step had.

    :param threshold: distance in metres at or below which the reward is 1, None for 0.06
    :param miss_reward: reward of every other step, 0 by default; baselines are often given -1
    :param kwargs: the base task's keywords
    :raises ValueError: for a threshold that is not positive and finite, a ``miss_reward`` that is not a finite number
        below 1, or a ``condition``
    """

    default_threshold: ClassVar[float] = 0.06

    def __init__(self, threshold: float | None = None, miss_reward: float = 0.0, **kwargs: Any) -> None:
        if "condition" in kwargs:
            raise ValueError(
                f"condition={kwargs['condition']!r} is not allowed here, the Reacher has one condition: leave it out, "
                "`threshold` is its distance"
            )
        if isinstance(miss_reward, bool) or not isinstance(miss_reward, _NUMBERS) or not -math.inf < miss_reward < 1.0:
            raise ValueError(f"miss_reward={miss_reward!r} must be a finite number below 1: give 0.0, or -1.0 for baselines")
        self.threshold = _check_threshold(threshold, self.default_threshold, "metres from the target")
        self.miss_reward = float(miss_reward)
        super().__init__(**kwargs)
        utils.EzPickle.__init__(self, threshold=threshold, miss_reward=miss_reward, **kwargs)

    def demonstrated_rewards(self, demonstrations: Demonstrations) -> np.ndarray:
        """From the distance to the target, which is observed; as recorded where a wrapper shows something else."""
        if demonstrations.next_observations.shape[1:] != self.observation_space.shape:
            return demonstrations.rewards
        distances = np.linalg.norm(demonstrations.next_observations[:, 8:], axis=1)  # fingertip minus target
        return np.where(distances <= self.threshold, 1.0, self.miss_reward).astype(np.float32)

    def demonstrated_positions(self, demonstrations: Demonstrations) -> np.ndarray:
        """Both joint angles and the target's position, (N, 4)."""
        cosines, sines, targets = np.split(demonstrations.next_observations[:, :6].astype(np.float64), 3, axis=1)
        return np.concatenate([np.arctan2(sines, cosines), targets], axis=1)

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
    :param threshold: metres or metres per second, None for the task's own ``default_distance`` or ``default_velocity``;
        with ``"forward"`` it may be 0: any forward motion is rewarded, the paper's wording for Walker2d, Hopper and Swimmer
    :param kwargs: the base task's keywords
    :raises ValueError: for an unknown condition, a threshold that is not positive and finite, or a ``miss_reward``
    """

    default_distance: ClassVar[float]
    default_velocity: ClassVar[float]

    _ctrl_cost_weight: float  # of the base task, as the next
    _forward_reward_weight: float

    def __init__(self, condition: str = "displacement", threshold: float | None = None, **kwargs: Any) -> None:
        if condition not in LOCOMOTION_CONDITIONS:
            raise ValueError(f"condition={condition!r} is not one of {LOCOMOTION_CONDITIONS}: choose one of these")
        if "miss_reward" in kwargs:
            raise ValueError(
                f"miss_reward={kwargs['miss_reward']!r} is not allowed here, other steps of a locomotion task give 0: "
                "leave it out, it is a keyword of the Reacher"
            )
        self.condition = condition
        self.distance, self.velocity = self.default_distance, self.default_velocity
        if condition == "displacement":
            self.distance = _check_threshold(threshold, self.default_distance, "metres from the start")
        else:
            self.velocity = _check_threshold(threshold, self.default_velocity, "metres per second", allow_zero=True)
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
        """From the forward velocity within the base task's reward, with its default weights or this environment's; the
        recorded ones where ``dense_rewards`` is None."""
        if demonstrations.dense_rewards is None:
            return demonstrations.rewards
        velocities = self._demonstrated_velocities(demonstrations)
        if self.condition == "forward":
            return (velocities > self.velocity).astype(np.float32)
        return (self._travelled(velocities, demonstrations) > self.distance).astype(np.float32)

    def demonstrated_positions(self, demonstrations: Demonstrations) -> np.ndarray:
        """The observed positions, and the distance travelled along x (the Swimmer's y, not observed either, stays 0); needs
        ``dense_rewards`` under the base task's default weights, or this environment's."""
        assert self.model is not None
        positions = np.zeros((len(demonstrations), self.model.nq))
        positions[:, 0] = self._travelled(self._demonstrated_velocities(demonstrations), demonstrations)
        n_observed = demonstrations.next_observations.shape[1] - self.model.nv
        positions[:, -n_observed:] = demonstrations.next_observations[:, :n_observed]
        return positions

    def _travelled(self, velocities: np.ndarray, demonstrations: Demonstrations) -> np.ndarray:
        """x - x_0 in metres after each transition, (N,) float64."""
        bounds = demonstrations.episode_bounds
        return np.concatenate([np.cumsum(velocities[start:end]) * self.dt for start, end in bounds])

    def _demonstrated_velocities(self, demonstrations: Demonstrations) -> np.ndarray:
        """Forward velocities in metres per second, (N,) float64: the base reward without control cost and health, weighed by
        default or as here, whichever agrees better with the velocities that are observed."""
        assert self.model is not None
        base: Any = next(kind for kind in type(self).__mro__ if kind.__module__.startswith("gymnasium"))
        arguments = inspect.signature(base.__init__).parameters
        default = {name: arguments[name].default for name in _REWARD_WEIGHTS if name in arguments}
        weighed = [default, {name: getattr(self, f"_{name}") for name in default}]
        velocities = [_velocities(demonstrations, **weights) for weights in weighed]
        if demonstrations.next_observations.shape[1:] != self.observation_space.shape:  # a wrapper shows something else
            return velocities[0]
        observed = demonstrations.next_observations[:, -self.model.nv]  # at the end of a step; Hopper and Walker2d clip it
        return min(velocities, key=lambda one: float(np.abs(one - observed).mean()))

    def _sparse_reward(self, info: dict[str, Any]) -> tuple[float, bool]:
        is_far = bool(self.data.qpos[0] - self._start_x > self.distance)
        self._has_passed = self._has_passed or is_far
        is_rewarded = is_far if self.condition == "displacement" else bool(info["x_velocity"] > self.velocity)
        return float(is_rewarded), self._has_passed


_REWARD_WEIGHTS = ("forward_reward_weight", "ctrl_cost_weight", "healthy_reward")


def _velocities(
    demonstrations: Demonstrations, forward_reward_weight: float, ctrl_cost_weight: float, healthy_reward: float = 0.0
) -> np.ndarray:
    assert demonstrations.dense_rewards is not None
    costs = ctrl_cost_weight * np.square(demonstrations.actions, dtype=np.float64).sum(axis=1)
    # -v4 rewards health also on the step that falls
    healthy = healthy_reward * ~(demonstrations.terminations & demonstrations.env_id.endswith("v5"))
    return (demonstrations.dense_rewards + costs - healthy) / forward_reward_weight


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
    thresholds = {"default_distance": _DISTANCES[task], "default_velocity": _VELOCITIES[task]}
    return type(name, (SparseLocomotionEnv, base), described | thresholds)


globals().update({made.__name__: made for made in map(_sparse_class, SPARSE_MUJOCO_IDS)})
