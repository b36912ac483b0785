"""Scripted demonstrators of the robosuite tasks: closed loops that see what the agent sees, and nothing else.

``proficiency`` sets how well one works, so that sets like robomimic's multi-human ones (Mandlekar et al., arXiv 2108.03298:
six people, two worse, two okay and two better, 50 demonstrations each) can be made.
"""

from contextlib import closing
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.envs import robosuite_layouts
from sb3_actpc.envs.robosuite_layouts import ACTION_DIM, RobosuiteTask, robosuite_task

METRES_PER_ACTION = 0.05
RADIANS_PER_ACTION = 0.5
# the arm covers about a third of the commanded distance in one control step, so three times the error does not overshoot
GAIN = 3.0
LONGEST_DETOUR = 30
OPEN, CLOSE = -1.0, 1.0
# the can's centre above the bins' walls; where it stands on the bin's floor
CARRYING_HEIGHT = 1.05
CAN_STANDING_HEIGHT = 0.86
CAN_BIN_CENTRE = (robosuite_layouts.CAN_BIN_LOW + robosuite_layouts.CAN_BIN_HIGH)[:2] / 2.0

MIXED_PROFICIENCIES = (0.1, 0.25, 0.45, 0.6, 0.85, 1.0)  # of the demonstrators of a mixed set: two worse, okay and better


@dataclass(frozen=True)
class View:
    """What a demonstrator reads from an observation: metres, radians, quaternions (x, y, z, w)."""

    eef_position: np.ndarray  # (3,) of the gripper
    eef_quat: np.ndarray  # (4,)
    finger_gap: float  # distance of the fingers
    object_position: np.ndarray  # (3,)
    object_quat: np.ndarray  # (4,)


class ScriptedDemonstrator:
    """Moves over the object, descends, grasps and lifts; carries and releases the can. Starts again when it loses the object.

    :param env_id: ``SparseLift-v0`` or ``SparsePickPlaceCan-v0``
    :param obs: the environment's ``obs``, ``"paper"`` or ``"robomimic"``
    :param proficiency: 1 is fast and accurate; 0 is slow and noisy, with pauses, detours and missed grasps
    :param seed: of the demonstrator's heights and, with the episode's seed, of its noise
    :raises ValueError: when an argument is not allowed
    """

    def __init__(self, env_id: str, obs: str = "paper", proficiency: float = 1.0, seed: int = 0) -> None:
        self.task: RobosuiteTask = robosuite_task(env_id)
        if isinstance(proficiency, bool) or not isinstance(proficiency, int | float) or not 0.0 <= proficiency <= 1.0:
            raise ValueError(f"proficiency={proficiency!r} must be a number from 0 (clumsy) to 1 (sure), or 'mixed'")
        self.seed = seed
        clumsiness = 1.0 - float(proficiency)
        self.speed = 1.0 - 0.6 * clumsiness  # largest translation action
        self.tremor = 0.25 * clumsiness  # standard deviation of the correlated noise on the actions
        self.pause_rate = 0.05 * clumsiness  # probability of a pause, per step
        self.detour_rate = 0.7 * clumsiness  # probability of a detour, per stage
        self.aim_error = 0.01 * clumsiness  # standard deviation of a grasp's place, in metres
        self.tolerance = 0.01 + 0.015 * clumsiness  # metres from the place aimed at, within which the fingers go down
        self._layout = self.task.layout(obs)
        self._object_columns = self.task.object_columns()
        heights = np.random.default_rng([seed, 0])
        self._hover_height = heights.uniform(0.06, 0.12)
        self._lift_height = heights.uniform(0.1, 0.2)
        self._stages = ["reach", "descend", "grasp", "lift"]
        self._stages += ["carry", "lower", "release"] if self.task.name == "PickPlaceCan" else []
        self.start(0)

    def start(self, seed: int) -> None:
        """A new episode begins; the same seed gives the same noise."""
        self._rng = np.random.default_rng([self.seed, 1, seed])
        self._noise = np.zeros(ACTION_DIM - 1)
        self._pause = 0
        self._last_gap = np.inf
        self._yaw: float | None = None
        self._enter("reach")

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Action (7,) float32, in [-1, 1], for an observation (obs_dim,)."""
        view = self._view(observation)
        if self.stage not in ("reach", "descend", "release") and self._has_lost(view):
            self._enter("reach")
        target, fingers, is_done = getattr(self, f"_{self.stage}")(view)
        if is_done and self.stage != self._stages[-1]:
            self._enter(self._stages[self._stages.index(self.stage) + 1])
        action = np.empty(ACTION_DIM)
        action[:3] = self._translation(view, target)
        action[3:6] = np.clip(GAIN * self._turn(view) / RADIANS_PER_ACTION, -self.speed, self.speed)
        action[:6] = self._disturb(action[:6])
        action[6] = fingers
        self._last_gap = view.finger_gap
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    # ------------------------------------------------------------------ stages: target (3,), fingers, done

    def _reach(self, view: View) -> tuple[np.ndarray, float, bool]:
        """Over the object, the fingers open and turned along it."""
        target = view.object_position + self._aim + np.array([0.0, 0.0, self._hover_height])
        is_above = np.linalg.norm((target - view.eef_position)[:2]) < self.tolerance
        aligned = is_above and np.linalg.norm(self._turn(view)) < 10.0 * self.tolerance
        return target, OPEN, bool(aligned and view.eef_position[2] < target[2] + 0.03)

    def _descend(self, view: View) -> tuple[np.ndarray, float, bool]:
        target = view.object_position + self._aim
        distance = np.linalg.norm((target - view.eef_position)[:2])
        if distance > self.tolerance + 0.02:
            self._enter("reach")
        elif distance > self.tolerance + 0.005:  # wait above it, do not push it over
            target = target + np.array([0.0, 0.0, 0.05])
        depth = 0.01 if self.task.name == "Lift" else 0.02
        return target, OPEN, bool(self.stage == "descend" and view.eef_position[2] < view.object_position[2] + depth)

    def _grasp(self, view: View) -> tuple[np.ndarray, float, bool]:
        """Close until the fingers stand still."""
        is_still = self._last_gap - view.finger_gap < 5e-4
        self._stage_steps += is_still
        return view.eef_position, CLOSE, bool(is_still and self._stage_steps > 3)

    def _lift(self, view: View) -> tuple[np.ndarray, float, bool]:
        height = CARRYING_HEIGHT if self.task.name == "PickPlaceCan" else robosuite_layouts.TABLE_HEIGHT + self._lift_height
        target = view.eef_position + np.array([0.0, 0.0, height + 0.03 - view.object_position[2]])
        return target, CLOSE, bool(self.task.name == "PickPlaceCan" and view.object_position[2] > height)

    def _carry(self, view: View) -> tuple[np.ndarray, float, bool]:
        way = np.array([*CAN_BIN_CENTRE, CARRYING_HEIGHT]) - view.object_position
        return view.eef_position + way, CLOSE, bool(np.linalg.norm(way[:2]) < 0.05)

    def _lower(self, view: View) -> tuple[np.ndarray, float, bool]:
        way = np.array([*CAN_BIN_CENTRE, CAN_STANDING_HEIGHT]) - view.object_position
        return view.eef_position + way, CLOSE, bool(view.object_position[2] < CAN_STANDING_HEIGHT + 0.02)

    def _release(self, view: View) -> tuple[np.ndarray, float, bool]:
        """Open, then move up and away, which ends the episode."""
        up = 0.2 if view.finger_gap > 0.07 else 0.0
        self._stage_steps += 1
        if self._stage_steps > 40:
            self._enter("reach")
        return view.eef_position + np.array([0.0, 0.0, up]), OPEN, False

    def _enter(self, stage: str) -> None:
        self.stage = stage
        self._stage_steps = 0
        if stage == "reach":
            self._aim = np.array([*self._rng.normal(0.0, self.aim_error, 2), 0.0])
        self._detour: np.ndarray | None = None
        self._detour_left = LONGEST_DETOUR
        if stage in ("reach", "carry") and self._rng.random() < self.detour_rate:
            self._detour = self._rng.uniform([-0.08, -0.08, 0.0], [0.08, 0.08, 0.06])

    def _has_lost(self, view: View) -> bool:
        """Whether the fingers have closed on nothing, or the object has slipped out of them."""
        return view.finger_gap < 0.01 or bool(np.linalg.norm(view.object_position - view.eef_position) > 0.06)

    def _translation(self, view: View, target: np.ndarray) -> np.ndarray:
        if self._detour is not None:
            target = target + self._detour
            self._detour_left -= 1
            if np.linalg.norm(target - view.eef_position) < 0.03 or self._detour_left == 0:
                self._detour = None
        command = GAIN * (target - view.eef_position) / METRES_PER_ACTION
        return command * min(1.0, self.speed / max(float(np.abs(command).max()), 1e-9))

    def _turn(self, view: View) -> np.ndarray:
        """Rotation vector (3,) that is left until the gripper points straight down, along the object's edges."""
        return turn_to_point_down(view.eef_quat, self._target_yaw(view))

    def _target_yaw(self, view: View) -> float:
        """The cube's angle modulo a quarter turn, nearest to the gripper's first one; for the round can, the gripper's own."""
        if self.task.name == "PickPlaceCan":
            return yaw_of(view.eef_quat)
        if self._yaw is None or self.stage == "reach":
            start = self._yaw or 0.0
            quarter = np.pi / 2.0
            self._yaw = start + (yaw_of(view.object_quat) - start + quarter / 2.0) % quarter - quarter / 2.0
        return self._yaw

    def _disturb(self, command: np.ndarray) -> np.ndarray:
        """Pauses and tremor; an autocorrelated noise, weaker on the rotation."""
        if self._pause == 0 and self._rng.random() < self.pause_rate:
            self._pause = int(self._rng.integers(3, 12))
        if self._pause > 0:
            self._pause -= 1
            command = np.zeros_like(command)
        scale = self.tremor * np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])
        self._noise = 0.8 * self._noise + 0.6 * self._rng.normal(0.0, 1.0, len(command))
        return command + scale * self._noise

    def _view(self, observation: np.ndarray) -> View:
        parts: dict[str, Any] = {name: np.asarray(observation[columns], float) for name, columns in self._layout.items()}
        fingers = parts["robot0_gripper_qpos"]
        return View(
            eef_position=parts["robot0_eef_pos"],
            eef_quat=parts["robot0_eef_quat"],
            finger_gap=float(fingers[0] - fingers[1]),
            object_position=parts["object"][self._object_columns["pos"]],
            object_quat=parts["object"][self._object_columns["quat"]],
        )


def collect_scripted(
    env_id: str,
    proficiency: float | Literal["mixed"] = 1.0,
    n_episodes: int = 50,
    seed: int = 0,
    obs: str = "paper",
    metadata: dict[str, Any] | None = None,
    **options: Any,
) -> Demonstrations:
    """Record successful episodes of scripted demonstrators.

    :param env_id: ``SparseLift-v0`` or ``SparsePickPlaceCan-v0``
    :param proficiency: in [0, 1], or ``"mixed"`` for those of ``MIXED_PROFICIENCIES``, which alternate
    :param n_episodes: successful episodes wanted
    :param seed: of the demonstrators and of the episodes
    :param obs: the environment's ``obs``
    :param metadata: JSON values to keep with the demonstrations
    :param options: further ones of :func:`~sb3_actpc.demonstrations.recording.record_episodes`
    :raises ValueError: when an argument is not allowed, or too few episodes succeed
    :raises ImportError: when robosuite is not installed
    """
    if proficiency == "mixed":
        parts = enumerate(MIXED_PROFICIENCIES)
        demonstrators = [ScriptedDemonstrator(env_id, obs, part, 100 * seed + i) for i, part in parts]
    else:
        demonstrators = [ScriptedDemonstrator(env_id, obs, proficiency, seed)]
    kept = {"demonstrator": "scripted", "proficiency": proficiency, **(metadata or {})}
    with closing(gym.make(env_id, obs=obs)) as env:
        return Demonstrations.record(demonstrators, env, n_episodes, True, seed=seed, metadata=kept, **options)


def yaw_of(quat: np.ndarray) -> float:
    """Angle about the vertical of the x axis that a quaternion (x, y, z, w) has turned."""
    x, y, z, w = quat
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def turn_to_point_down(quat: np.ndarray, yaw: float) -> np.ndarray:
    """Rotation vector (3,), in radians, from an orientation (x, y, z, w) to that of a gripper which points straight down, its
    x axis at an angle about the vertical."""
    from scipy.spatial.transform import Rotation

    return (Rotation.from_euler("ZX", [yaw, np.pi]) * Rotation.from_quat(quat).inv()).as_rotvec()
