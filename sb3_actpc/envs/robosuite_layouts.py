"""What a robosuite observation holds, and when a task is solved: arrays alone, robosuite is not needed.

The parts have robomimic's names (``robot0_eef_pos``, ..., ``object``), so that its files can be read without a simulator.
Positions are in metres in the world's frame, angles in radians, velocities per second; quaternions are (x, y, z, w).
"""

from dataclasses import dataclass

import numpy as np

PROPRIOCEPTION: dict[str, int] = {
    "robot0_joint_pos_cos": 7,
    "robot0_joint_pos_sin": 7,
    "robot0_joint_vel": 7,
    "robot0_eef_pos": 3,
    "robot0_eef_quat": 4,
    "robot0_gripper_qpos": 2,
    "robot0_gripper_qvel": 2,
}
OBSERVATIONS: dict[str, tuple[str, ...]] = {
    # Ororbia & Mali (arXiv 2209.09174, appendix): 42 and 46 numbers
    "paper": (*PROPRIOCEPTION, "object"),
    # robomimic's low-dimensional keys: 19 and 23 numbers
    "robomimic": ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos", "object"),
}
ACTION_DIM = 7  # translation (3), rotation (3) and gripper (1; positive closes), each in [-1, 1]; 1 is 5 cm or 0.5 rad


@dataclass(frozen=True)
class RobosuiteTask:
    """What a task's observations hold, and when it is solved."""

    env_id: str  # Gymnasium id
    name: str  # robosuite's
    object_parts: dict[str, int]  # the parts of the object's state, in order, and their sizes

    def layout(self, obs: str) -> dict[str, slice]:
        """Part -> its columns in an observation, in order; ValueError for an ``obs`` that is no key of ``OBSERVATIONS``."""
        if obs not in OBSERVATIONS:
            raise ValueError(f"obs={obs!r} is not one of {', '.join(OBSERVATIONS)}: choose one of these")
        sizes = self.part_sizes()
        return _columns({part: sizes[part] for part in OBSERVATIONS[obs]})

    def part_sizes(self) -> dict[str, int]:
        """Part of an observation -> its size."""
        return {**PROPRIOCEPTION, "object": sum(self.object_parts.values())}

    def obs_dim(self, obs: str) -> int:
        """Size of an observation, for a key of ``OBSERVATIONS``."""
        return self.layout(obs)["object"].stop

    def object_columns(self) -> dict[str, slice]:
        """Part of the object's state -> its columns in it."""
        return _columns(self.object_parts)

    def object_states(
        self, positions: np.ndarray, quats: np.ndarray, eef_positions: np.ndarray, eef_quats: np.ndarray
    ) -> np.ndarray:
        """The object's states, (N, object_dim) in the order of robosuite 1.5, from its positions (N, 3) and quaternions
        (N, 4), (x, y, z, w), and the gripper's.

        The can is seen in the gripper's frame, with a quaternion whose w is not negative; the cube's position relative to the
        gripper is in the world's frame.
        """
        offsets = positions - eef_positions
        if self.name == "Lift":
            return np.concatenate([positions, quats, offsets], axis=1)
        from scipy.spatial.transform import Rotation

        to_gripper = Rotation.from_quat(eef_quats).inv()
        relative_positions = to_gripper.apply(offsets)
        relative_quats = (to_gripper * Rotation.from_quat(quats)).as_quat()
        relative_quats = np.where(relative_quats[:, 3:] < 0.0, -relative_quats, relative_quats)
        return np.concatenate([relative_positions, relative_quats, positions, quats], axis=1)

    def is_success(self, object_states: np.ndarray, eef_positions: np.ndarray) -> np.ndarray:
        """robosuite's success, (N,) bool, from observed states of the object (N, object_dim) and positions of the gripper
        (N, 3). Lift: the cube's centre is more than 4 cm above the table. Can: the can lies in its quarter of the right-
        hand bin and the gripper is off it."""
        positions = object_states[:, self.object_columns()["pos"]]
        if self.name == "Lift":
            return positions[:, 2] > TABLE_HEIGHT + 0.04
        distances = np.linalg.norm(eef_positions - positions, axis=1)
        inside = ((positions > CAN_BIN_LOW) & (positions < CAN_BIN_HIGH)).all(axis=1)
        return inside & (1.0 - np.tanh(10.0 * distances) < 0.6)


def _columns(sizes: dict[str, int]) -> dict[str, slice]:
    """Name -> its columns, of parts that follow each other."""
    ends = np.cumsum(list(sizes.values())).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


# of robosuite 1.5.2: environments/manipulation/{lift,pick_place}.py
TABLE_HEIGHT = 0.8
BIN_SIZE = (0.39, 0.49)
CAN_BIN_LOW = np.array([0.1, 0.28, 0.8])
CAN_BIN_HIGH = CAN_BIN_LOW + np.array([BIN_SIZE[0] / 2, BIN_SIZE[1] / 2, 0.1])

ROBOSUITE_TASKS: dict[str, RobosuiteTask] = {
    task.env_id: task
    for task in (
        RobosuiteTask("SparseLift-v0", "Lift", {"pos": 3, "quat": 4, "to_eef_pos": 3}),
        RobosuiteTask("SparsePickPlaceCan-v0", "PickPlaceCan", {"to_eef_pos": 3, "to_eef_quat": 4, "pos": 3, "quat": 4}),
    )
}


def robosuite_task(env_id: str) -> RobosuiteTask:
    """The task of a Gymnasium id, with or without the module before a colon; ValueError when it is none of
    ``ROBOSUITE_TASKS``."""
    task = ROBOSUITE_TASKS.get(env_id.rpartition(":")[2])
    if task is None:
        raise ValueError(f"{env_id!r} is not a robosuite task: choose one of {', '.join(ROBOSUITE_TASKS)}")
    return task
