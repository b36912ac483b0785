"""Goal versions of the sparse MuJoCo tasks, for hindsight experience replay (Andrychowicz et al., arXiv 1707.01495).

Observations are dictionaries of ``observation``, ``achieved_goal`` and ``desired_goal``. The Reacher's goals are positions
of its fingertip; what it observes of the target is in ``desired_goal`` alone, or a relabelled transition would still show the
old one. The locomotion tasks have no goal of their own (the paper says so of HER): here it is the distance at which the
``"displacement"`` condition gives a reward, and what is achieved is the distance from the start.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_actpc.envs import sparse_mujoco

if TYPE_CHECKING:
    from sb3_actpc.demonstrations.dataset import Demonstrations

Observation = dict[str, np.ndarray]
_REACHER_OWN = [0, 1, 2, 3, 6, 7]  # joint angles and velocities
_REACHER_TARGET = slice(4, 6)
_REACHER_DIFFERENCE = slice(8, 10)  # fingertip minus target; -v4 has its height too, always 0


class GoalTask(gym.ObservationWrapper[Any, np.ndarray, Any]):
    """A sparse task as a goal task: the same physics, time limits and ``info``; ``n_own`` is the size of ``observation``,
    ``n_goal`` that of a goal."""

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray], n_own: int, n_goal: int) -> None:
        super().__init__(env)
        sizes = {"observation": n_own, "achieved_goal": n_goal, "desired_goal": n_goal}
        boxes: dict[str, spaces.Space[Any]] = {
            key: spaces.Box(-np.inf, np.inf, (size,), np.float64) for key, size in sizes.items()
        }
        self.observation_space = spaces.Dict(boxes)

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """As the sparse task's, with the dictionary and the reward of :meth:`compute_reward`."""
        row, _, terminated, truncated, info = super().step(action)
        reward = self.compute_reward(row["achieved_goal"], row["desired_goal"], info)
        return row, float(reward), terminated, truncated, info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Rewards () or (N,), of goals (n_goal,) or (N, n_goal); ``info`` is not used."""
        raise NotImplementedError

    def demonstrated_rewards(self, demonstrations: Demonstrations) -> np.ndarray:
        """The rewards of transitions that :meth:`goal_demonstrations` made: as they are, (N,)."""
        return demonstrations.rewards

    def goal_demonstrations(self, demonstrations: Demonstrations) -> Demonstrations:
        """Recorded transitions of the sparse task as transitions of this one: flattened dictionaries, with the rewards of
        :meth:`compute_reward`. Demonstrations of this task, and of others, are returned as they are. ValueError when the
        recording lacks what was achieved."""
        spec = self.spec
        env_id = demonstrations.env_id if spec is None else spec.id
        recorded, own = (name.rpartition(":")[2].rpartition("-v")[0] for name in (demonstrations.env_id, env_id))
        fits = demonstrations.observations.shape[1:] == self.env.observation_space.shape
        if recorded != own.replace("Goal", "Sparse", 1) or not fits:
            return demonstrations
        rows, next_rows = self._demonstrated_rows(demonstrations)
        return dataclasses.replace(
            demonstrations,
            # the order of a Dict space
            observations=np.concatenate([rows[key] for key in sorted(rows)], axis=1),
            next_observations=np.concatenate([next_rows[key] for key in sorted(rows)], axis=1),
            rewards=self.compute_reward(next_rows["achieved_goal"], next_rows["desired_goal"], None),
            env_id=env_id,
        )

    def _demonstrated_rows(self, demonstrations: Demonstrations) -> tuple[Observation, Observation]:
        """Observations and next observations of N transitions, (N, size) each."""
        return self.observation(demonstrations.observations), self.observation(demonstrations.next_observations)


class GoalReacher(GoalTask):
    """Goals are positions of the fingertip in the plane, in metres, (2,); the sparse Reacher's threshold and ``miss_reward``
    count."""

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray]) -> None:
        super().__init__(env, len(_REACHER_OWN), 2)

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """1 at or below the threshold's distance, else ``miss_reward``; see :meth:`GoalTask.compute_reward`."""
        task: Any = self.unwrapped
        distances = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return np.where(distances <= task.threshold, 1.0, task.miss_reward)

    def observation(self, observation: np.ndarray) -> Observation:
        """The dictionary of the sparse task's observation, or of n of them, (..., obs_dim)."""
        target = observation[..., _REACHER_TARGET]
        return {
            "observation": observation[..., _REACHER_OWN],
            "achieved_goal": observation[..., _REACHER_DIFFERENCE] + target,
            "desired_goal": target,
        }


class GoalLocomotion(GoalTask):
    """A goal is a distance from the start along x, in metres, (1,): reached at or beyond it. It is the threshold of
    a sparse locomotion task with the ``"displacement"`` condition; ValueError for another condition."""

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray]) -> None:
        task: Any = env.unwrapped
        if task.condition != "displacement":
            raise ValueError(f"condition={task.condition!r} has no goal that is a position: leave it at 'displacement'")
        super().__init__(env, int(np.prod(env.observation_space.shape or ())), 1)

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """1 at or beyond the desired distance, else 0; see :meth:`GoalTask.compute_reward`."""
        return np.where((achieved_goal >= desired_goal)[..., 0], 1.0, 0.0)

    def observation(self, observation: np.ndarray) -> Observation:
        """The dictionary of the sparse task's present observation."""
        task: Any = self.unwrapped
        travelled = np.array([task.data.qpos[0] - task._start_x])
        return {"observation": observation, "achieved_goal": travelled, "desired_goal": np.array([task.distance])}

    def _demonstrated_rows(self, demonstrations: Demonstrations) -> tuple[Observation, Observation]:
        if demonstrations.dense_rewards is None:
            raise ValueError(
                f"demonstrations of {demonstrations.env_id}: dense_rewards are missing, from which the distance travelled is "
                "computed: record them again (sb3-actpc demos collect)"
            )
        task: Any = self.unwrapped
        moved = task.demonstrated_velocities(demonstrations) * task.dt
        after = np.concatenate([np.cumsum(moved[start:end]) for start, end in demonstrations.episode_bounds])
        desired = np.full((len(after), 1), task.distance)
        rows = {"observation": demonstrations.observations, "achieved_goal": (after - moved)[:, None], "desired_goal": desired}
        return rows, {**rows, "observation": demonstrations.next_observations, "achieved_goal": after[:, None]}


def make_goal_env(task: str, **kwargs: Any) -> GoalTask:
    """Entry point of the ids ``Goal...``: the goal task of a class in :mod:`sb3_actpc.envs.sparse_mujoco`, with its
    keywords."""
    env = getattr(sparse_mujoco, task)(**kwargs)
    return GoalReacher(env) if isinstance(env, sparse_mujoco.SparseReacherEnv) else GoalLocomotion(env)
