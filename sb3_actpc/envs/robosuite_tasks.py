"""Block lifting and can pick-and-place: robosuite's Panda tasks with sparse rewards, as Gymnasium environments.

The tasks are those of Ororbia & Mali (arXiv 2209.09174): a Panda arm under operational-space control of the gripper's pose
(OSC_POSE, 20 Hz). Robosuite (the extra ``sb3-actpc[robosuite]``) is imported when an environment is made.

An environment here *contains* a robosuite environment. It differs from robosuite's own loop in what is reported, not in the
physics: the horizon is a truncation, success a termination; observations and success are read from the poses at the end of
the control step (robosuite's lag behind by one simulation step, 2 ms, and the can's pose in the gripper's frame by one control
step); the random numbers are Gymnasium's.
"""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces, utils

from sb3_actpc.envs.robosuite_layouts import ACTION_DIM, RobosuiteTask, robosuite_task
from sb3_actpc.utils.extras import import_extra

CONTROL_FREQUENCY = 20
# of robosuite 1.5.2 (environments/manipulation/lift.py): half edges in metres, density in kg/m^3
CUBE_HALF_EDGES = (0.020, 0.022)
CUBE_DENSITY = 1000.0
REACH = 0.05  # metres between gripper and object's centre within which it is reached
PICTURE_SIZE = 384  # pixels
LIFTED = 0.1  # metres above the bin's floor at which a held can counts as lifted (at rest its centre is at some 6 cm)


class SparseRobosuiteEnv(gym.Env[np.ndarray, np.ndarray], utils.EzPickle):
    """Reward 1 on success, which ends the episode, else 0.

    Actions are (7,) in [-1, 1]: translation of the gripper (1 is 5 cm), its rotation (1 is 0.5 rad), both in the frame of
    the robot's base, and the fingers (positive closes). ``info["dense_reward"]`` is robosuite's shaped reward,
    ``info["is_success"]`` its success, ``info["stage"]`` the farthest stage of the episode so far: one of ``stages``.

    A reset takes milliseconds: robosuite's soft reset, after which the state depends on the seed alone.

    :param obs: ``"paper"`` (42 numbers in Lift, 46 in Can: joint angles' cosines and sines, joint velocities, the gripper's
        position, quaternion, finger positions and velocities, and the object's state) or ``"robomimic"`` (19 and 23: the
        gripper's position, quaternion and finger positions, and the object's state); float32
    :param horizon: control steps after which an episode is truncated
    :param render_mode: ``"rgb_array"``, or None
    :raises ImportError: when robosuite is not installed
    :raises ValueError: when a keyword has a value that is not allowed
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": CONTROL_FREQUENCY}  # type: ignore[misc]
    env_id: ClassVar[str]
    stages: ClassVar[tuple[str, ...]]

    # what robosuite holds is put into checkpoints by checkpoint_state
    checkpoint_skipped: ClassVar[tuple[str, ...]] = ("simulation", "_renderer", "_layout", "task")

    def __init__(self, obs: str = "paper", horizon: int = 500, render_mode: str | None = None) -> None:
        self.task: RobosuiteTask = robosuite_task(self.env_id)
        self._layout = self.task.layout(obs)
        if int(horizon) != horizon or horizon < 1:
            raise ValueError(f"horizon={horizon!r} must be a whole number of at least 1: give one, or leave it out")
        utils.EzPickle.__init__(self, obs, horizon, render_mode)
        self.horizon = int(horizon)
        self.render_mode = render_mode
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.task.obs_dim(obs),), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
        self.simulation: Any = make_simulation(self.task.name)
        self.model: Any = self.simulation.sim.model._model
        self.data: Any = self.simulation.sim.data._data
        self._renderer: mujoco.Renderer | None = None
        self._elapsed_steps = 0
        self._stage = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode: the arm near its rest pose, the object at a random place; the same seed gives the same state bit
        for bit, None goes on with the generator. ``options`` are not used; the info is ``{"is_success": False, "stage":
        "start"}``."""
        super().reset(seed=seed)
        share_generator(self.simulation, self.np_random)
        self._randomize_model()
        self.simulation.reset()
        self._elapsed_steps = 0
        self._stage = 0
        return self._observe(), {"is_success": False, "stage": self.stages[0]}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance by one control step, 1/20 s, with an action (7,): observation (obs_dim,), reward (1 on success, else 0),
        terminated (success), truncated (the horizon), info with ``dense_reward`` (float), ``is_success`` (bool) and ``stage``
        (str)."""
        dense_reward = float(self.simulation.step(np.asarray(action, dtype=np.float64))[1])
        self._elapsed_steps += 1
        observation = self._observe()
        is_success = bool(self.simulation._check_success())
        is_truncated = not is_success and self._elapsed_steps >= self.horizon
        self._stage = max(self._stage, len(self.stages) - 1 if is_success else self._present_stage())
        info = {"dense_reward": dense_reward, "is_success": is_success, "stage": self.stages[self._stage]}
        return observation, float(is_success), is_success, is_truncated, info

    def observe_state(self, state: np.ndarray) -> np.ndarray:
        """Put the simulation into a recorded state (time, joint positions, joint velocities, as robosuite records them) and
        observe it; ValueError when the state is of another size, so of another task."""
        self.data.time = state[0]
        self.data.qpos[:], self.data.qvel[:] = state[1 : 1 + self.model.nq], state[1 + self.model.nq :]
        mujoco.mj_forward(self.model, self.data)
        return self._observe()

    def render(self) -> np.ndarray | None:
        """robosuite's ``agentview``, (384, 384, 3) uint8; None without a render mode. RuntimeError (or what the OpenGL library
        raises) when the machine cannot render."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self.model, PICTURE_SIZE, PICTURE_SIZE)
        options = mujoco.MjvOption()
        options.geomgroup[0] = 0  # collision shapes
        self._renderer.update_scene(self.data, camera="agentview", scene_option=options)
        return self._renderer.render().copy()

    def close(self) -> None:
        """Free the simulation and the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        if self.simulation.sim is not None:
            self.simulation.close()

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint needs beside ``data`` and the generators: plain values of the controllers, the gripper and the
        counters."""
        return {name: _plain_attributes(part) for name, part in _stateful_parts(self.simulation).items()}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """:param state: what :meth:`checkpoint_state` returned"""
        share_generator(self.simulation, self.np_random)
        for name, part in _stateful_parts(self.simulation).items():
            vars(part).update(state[name])

    def _randomize_model(self) -> None:
        """Draw what differs between the models of two episodes."""

    def _observe(self) -> np.ndarray:
        mujoco.mj_kinematics(self.model, self.data)  # a control step ends with poses from before its last simulation step
        parts = self._observation_parts()
        return np.concatenate([parts[name] for name in self._layout]).astype(np.float32)

    def _observation_parts(self) -> dict[str, np.ndarray]:
        robot = self.simulation.robots[0]
        joints = self.data.qpos[robot._ref_joint_pos_indexes]
        eef_quat = np.roll(self.data.body(robot.robot_model.eef_name["right"]).xquat, -1)  # (w, x, y, z) to (x, y, z, w)
        eef_position = self.data.site_xpos[robot.eef_site_id["right"]]
        body = self._object_body()
        position, quat = body.xpos, np.roll(body.xquat, -1)
        return {
            "robot0_joint_pos_cos": np.cos(joints),
            "robot0_joint_pos_sin": np.sin(joints),
            "robot0_joint_vel": self.data.qvel[robot._ref_joint_vel_indexes],
            "robot0_eef_pos": eef_position,
            "robot0_eef_quat": eef_quat,
            "robot0_gripper_qpos": self.data.qpos[robot._ref_gripper_joint_pos_indexes["right"]],
            "robot0_gripper_qvel": self.data.qvel[robot._ref_gripper_joint_vel_indexes["right"]],
            "object": self.task.object_states(position[None], quat[None], eef_position[None], eef_quat[None])[0],
        }

    def _present_stage(self) -> int:
        """Index in ``stages`` of what the gripper is at, success left aside."""
        gripper = self.data.site_xpos[self.simulation.robots[0].eef_site_id["right"]]
        if self.simulation._check_grasp(gripper=self.simulation.robots[0].gripper, object_geoms=self._graspable()):
            return self.stages.index("grasp")
        return int(np.linalg.norm(self._object_body().xpos - gripper) < REACH)

    def _graspable(self) -> Any:
        """robosuite's model of the object."""
        raise NotImplementedError

    def _object_body(self) -> Any:
        """The object's body in the simulation."""
        return self.data.body(self._graspable().root_body)


class SparseLiftEnv(SparseRobosuiteEnv):
    """Lift a cube more than 4 cm off the table; its place, its angle and its edges are random.

    The object's state is the cube's position (3), its quaternion (4) and its position relative to the gripper (3).
    """

    env_id = "SparseLift-v0"
    stages = ("start", "reach", "grasp", "lift")

    def _randomize_model(self) -> None:
        resize_cube(self.simulation, self.np_random.uniform(*CUBE_HALF_EDGES, size=3))

    def _graspable(self) -> Any:
        return self.simulation.cube

    def checkpoint_state(self) -> dict[str, Any]:
        """As above, and the cube's half edges in metres, (3,)."""
        return {**super().checkpoint_state(), "cube": np.array(self.simulation.cube.size)}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """:param state: what :meth:`checkpoint_state` returned"""
        resize_cube(self.simulation, state["cube"])
        super().restore_checkpoint_state(state)


class SparsePickPlaceCanEnv(SparseRobosuiteEnv):
    """Carry a can from the left bin into its quarter of the right one and let it go; its place and angle are random.

    The object's state is the can's position (3) and quaternion (4) in the gripper's frame, its position (3) and its
    quaternion (4) in the world's.
    """

    env_id = "SparsePickPlaceCan-v0"
    stages = ("start", "reach", "grasp", "lift", "place")

    def _present_stage(self) -> int:
        stage = super()._present_stage()
        height = self._object_body().xpos[2] - self.simulation.bin1_pos[2]
        is_lifted = self.stages[stage] == "grasp" and height > LIFTED
        return self.stages.index("lift") if is_lifted else stage

    def _graspable(self) -> Any:
        return self.simulation.objects[self.simulation.object_id]


def make_simulation(name: str, **kwargs: Any) -> Any:
    """A robosuite environment of the Panda with soft resets, shaped rewards and neither renderer nor time limit; ``name``
    is robosuite's, ``kwargs`` are its keywords and replace ours. robosuite's own observations are off, unless
    ``use_object_obs`` is true: ours are read from the simulation."""
    with _quiet_import():
        robosuite = import_extra("robosuite", "robosuite")
        settings = dict(
            robots="Panda",
            controller_configs=robosuite.load_composite_controller_config(robot="Panda"),
            control_freq=CONTROL_FREQUENCY,
            has_renderer=False,
            has_offscreen_renderer=False,
            renderer="mujoco",
            use_camera_obs=False,
            use_object_obs=False,
            reward_shaping=True,
            hard_reset=False,
            ignore_done=True,
        )
        simulation = robosuite.make(name, **{**settings, **kwargs})
        if not kwargs.get("use_object_obs", False):
            for observable in simulation.observation_names:
                simulation.modify_observable(observable, "enabled", False)
    return simulation


def share_generator(simulation: Any, generator: np.random.Generator) -> None:
    """Let a robosuite environment draw its random numbers from a generator."""
    simulation.rng = generator
    samplers = [simulation.placement_initializer]
    while samplers:
        sampler = samplers.pop()
        sampler.rng = generator
        samplers += getattr(sampler, "samplers", {}).values()


def resize_cube(simulation: Any, half_edges: np.ndarray) -> None:
    """Give Lift's cube other half edges, (3,) in metres, as if the model had been compiled with them (robosuite compiles it
    for each episode). The state of the simulation is lost: reset it or restore one."""
    model, data = simulation.sim.model._model, simulation.sim.data._data
    simulation.cube.size = [float(edge) for edge in half_edges]
    body = model.body(simulation.cube.root_body).id
    geoms = np.flatnonzero(model.geom_bodyid == body)
    model.geom_size[geoms] = model.geom_aabb[geoms, 3:] = half_edges
    model.geom_rbound[geoms] = np.linalg.norm(half_edges)
    start = model.body_bvhadr[body]
    model.bvh_aabb[start : start + model.body_bvhnum[body], 3:] = half_edges
    model.body_mass[body] = 8.0 * CUBE_DENSITY * np.prod(half_edges)
    squares = np.square(half_edges)
    model.body_inertia[body] = model.body_mass[body] / 3.0 * (squares.sum() - squares)
    mujoco.mj_setConst(model, data)


@contextmanager
def _quiet_import() -> Iterator[None]:
    """Without robosuite's greetings, and its choice of an OpenGL library, with which child processes may not find MuJoCo's."""
    backend = {name: value for name, value in os.environ.items() if name == "MUJOCO_GL"}
    disabled = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(disabled)
        os.environ.pop("MUJOCO_GL", None)
        os.environ.update(backend)


def _stateful_parts(simulation: Any) -> dict[str, Any]:
    """The objects whose plain attributes change from step to step."""
    robot = simulation.robots[0]
    parts = {"environment": simulation, "gripper": robot.gripper["right"]}
    return parts | {f"controller_{name}": part for name, part in robot.composite_controller.part_controllers.items()}


def _plain_attributes(part: Any) -> dict[str, Any]:
    """Numbers, flags, and arrays of numbers among an object's attributes (arrays copied)."""
    plain: dict[str, Any] = {}
    for name, value in vars(part).items():
        is_array = isinstance(value, np.ndarray) and value.dtype.kind in "bif"
        if is_array or value is None or type(value) in (bool, int, float):
            plain[name] = value.copy() if is_array else value
    return plain
