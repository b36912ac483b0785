"""The robosuite tasks pay, observe and end as they say, and their physics is robosuite's."""

import os
import pickle
import random
import subprocess
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_actpc.demonstrations import ScriptedDemonstrator
from sb3_actpc.envs import ROBOSUITE_IDS, robosuite_tasks
from sb3_actpc.envs.robosuite_layouts import ROBOSUITE_TASKS, robosuite_task

pytest.importorskip("robosuite", reason="robosuite is an extra")

pytestmark = pytest.mark.filterwarnings("ignore:.*infinity.*", "ignore:.*precision.*")

OBS_DIMS = {("SparseLift-v0", "paper"): 42, ("SparseLift-v0", "robomimic"): 19}
OBS_DIMS |= {("SparsePickPlaceCan-v0", "paper"): 46, ("SparsePickPlaceCan-v0", "robomimic"): 23}


@pytest.fixture(scope="module")
def envs() -> Iterator[dict[str, Any]]:
    """One environment of each task, unwrapped."""
    made: dict[str, Any] = {env_id: gym.make(env_id).unwrapped for env_id in ROBOSUITE_IDS}
    yield made
    for env in made.values():
        env.close()


@pytest.fixture(scope="module")
def others() -> Iterator[dict[str, Any]]:
    """Environments of the same tasks with another past."""
    made: dict[str, Any] = {env_id: gym.make(env_id, obs="robomimic").unwrapped for env_id in ROBOSUITE_IDS}
    for env in made.values():
        env.reset(seed=77)
        for action in actions_of(30, seed=9):
            env.step(action)
    yield made
    for env in made.values():
        env.close()


def actions_of(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 7)).astype(np.float32)


def robosuite_env(env_id: str, **kwargs: Any) -> Any:
    """robosuite's own environment, with its own observations."""
    return robosuite_tasks.make_simulation(robosuite_task(env_id).name, use_object_obs=True, **kwargs)


def copy_state(source: Any, target: Any) -> None:
    """Put a robosuite environment into the state of ours, just reset."""
    target.sim.data._data.qpos[:], target.sim.data._data.qvel[:] = source.data.qpos, source.data.qvel
    target.sim.data._data.qacc_warmstart[:] = source.data.qacc_warmstart
    target.sim.forward()


def move_object(env: Any, position: list[float]) -> None:
    """Put the cube or the can somewhere, at rest."""
    simulation = env.simulation
    thing = simulation.cube if env.env_id == "SparseLift-v0" else simulation.objects[simulation.object_id]
    start = env.model.joint(thing.joints[0]).qposadr[0]
    env.data.qpos[start : start + 3] = position
    env.data.qvel[env.model.joint(thing.joints[0]).dofadr[0] :][:6] = 0.0


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_both_checkers_accept_the_task(env_id: str) -> None:
    env = gym.make(env_id, horizon=20)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gymnasium_check_env(env.unwrapped, skip_render_check=True)
        sb3_check_env(env)
    env.close()


@pytest.mark.parametrize(("env_id", "obs"), OBS_DIMS)
def test_observations_are_those_of_robosuite(env_id: str, obs: str, envs: dict[str, Any], others: dict[str, Any]) -> None:
    env = envs[env_id] if obs == "paper" else others[env_id]
    assert env.observation_space.shape == (OBS_DIMS[env_id, obs],)
    observation, _ = env.reset(seed=5)
    for action in actions_of(5):
        observation, *_ = env.step(action)
    theirs = robosuite_env(env_id)
    theirs.reset()
    copy_state(env, theirs)
    for _ in range(2):  # the can's pose in the gripper's frame is computed from the pose that was observed before
        expected = theirs._get_observations(force_update=True)
    expected["object"] = expected["object-state"]
    for part, columns in ROBOSUITE_TASKS[env_id].layout(obs).items():
        np.testing.assert_allclose(observation[columns], expected[part], atol=1e-6, err_msg=part)
    assert observation.dtype == np.float32
    theirs.close()


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_physics_and_dense_rewards_are_robosuites_bit_for_bit(env_id: str, envs: dict[str, Any]) -> None:
    env = envs[env_id]
    env.reset(seed=2)
    theirs = robosuite_env(env_id)
    robosuite_tasks.share_generator(theirs, np.random.default_rng(0))
    theirs.rng.bit_generator.state = np.random.default_rng(2).bit_generator.state
    if env_id == "SparseLift-v0":
        robosuite_tasks.resize_cube(theirs, theirs.rng.uniform(0.020, 0.022, size=3))
    theirs.reset()
    for action in actions_of(25):
        *_, info = env.step(action)
        _, reward, *_ = theirs.step(action.astype(np.float64))
        np.testing.assert_array_equal(env.data.qpos, theirs.sim.data.qpos)
        assert info["dense_reward"] == reward
    theirs.close()


def test_a_resized_cube_is_the_one_that_robosuite_would_compile(envs: dict[str, Any]) -> None:
    env = envs["SparseLift-v0"]
    compiled = robosuite_env("SparseLift-v0", seed=4)
    robosuite_tasks.resize_cube(env.simulation, np.array(compiled.cube.size))
    model = compiled.sim.model._model
    names = [name for name in dir(model) if isinstance(getattr(model, name), np.ndarray) and name != "site_rgba"]
    assert {"body_mass", "body_inertia", "geom_size", "geom_rbound", "geom_aabb", "bvh_aabb", "dof_invweight0"} < {*names}
    for name in names:
        np.testing.assert_allclose(getattr(env.model, name), getattr(model, name), rtol=1e-9, atol=1e-12, err_msg=name)
    compiled.close()


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_the_same_seed_gives_the_same_episode_bit_for_bit_whatever_came_before(
    env_id: str, envs: dict[str, Any], others: dict[str, Any]
) -> None:
    states = []
    for env in (envs[env_id], others[env_id], envs[env_id]):
        env.reset(seed=11)
        for action in actions_of(15):
            env.step(action)
        states.append(np.concatenate([env.data.qpos, env.data.qvel]))
    np.testing.assert_array_equal(states[0], states[1])
    np.testing.assert_array_equal(states[0], states[2])


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_other_seeds_and_later_episodes_have_the_object_elsewhere(env_id: str, envs: dict[str, Any]) -> None:
    env = envs[env_id]
    before = pickle.dumps((np.random.get_state(), random.getstate()))
    resets = [env.reset(seed=1)[0], env.reset()[0], env.reset(seed=2)[0]]
    env.step(env.action_space.low)
    assert pickle.dumps((np.random.get_state(), random.getstate())) == before, "the global generators are left alone"
    columns = env.task.layout("paper")["object"]
    positions = np.stack([observation[columns][env.task.object_columns()["pos"]] for observation in resets])
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(positions[i] - positions[j])[:2].max() > 1e-4


LIFT, CAN = ROBOSUITE_IDS
# on the table, and lifted; above the bin, in the left bin, in the cereal's quarter, in its own
PLACES = [(LIFT, [0.2, 0.2, 0.821], False), (LIFT, [0.2, 0.2, 0.835], False), (LIFT, [0.2, 0.2, 0.9], True)]
PLACES += [(CAN, [0.2, 0.4, 1.0], False), (CAN, [0.1, -0.2, 0.86], False), (CAN, [0.0, 0.4, 0.86], False)]
PLACES += [(CAN, [0.2, 0.4, 0.86], True)]


@pytest.mark.parametrize(("env_id", "position", "expected"), PLACES)
def test_success_ends_the_episode_with_reward_1(
    env_id: str, position: list[float], expected: bool, envs: dict[str, Any]
) -> None:
    env = envs[env_id]
    env.reset(seed=0)
    move_object(env, position)
    _, reward, terminated, truncated, info = env.step(np.zeros(7))
    assert (reward, terminated, truncated, info["is_success"]) == (float(expected), expected, False, expected)
    assert type(info["is_success"]) is bool and type(info["dense_reward"]) is float


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_a_sure_operator_passes_every_stage_in_order(env_id: str, envs: dict[str, Any]) -> None:
    env, operator = envs[env_id], ScriptedDemonstrator(env_id)
    operator.start(seed=0)
    observation, info = env.reset(seed=0)
    passed, terminated = [info["stage"]], False
    while not terminated:
        observation, _, terminated, truncated, info = env.step(operator(observation))
        assert not truncated
        if info["stage"] != passed[-1]:
            passed.append(info["stage"])
    assert tuple(passed) == env.stages


def test_the_stage_is_the_farthest_of_the_episode(envs: dict[str, Any]) -> None:
    env = envs["SparsePickPlaceCan-v0"]
    env.reset(seed=0)
    for _ in range(3):
        assert env.step(np.zeros(7))[4]["stage"] == "start"
    gripper = env.data.site_xpos[env.simulation.robots[0].eef_site_id["right"]].copy()
    move_object(env, [*gripper[:2], gripper[2] - 0.03])
    assert env.step(np.zeros(7))[4]["stage"] == "reach"
    move_object(env, [gripper[0] + 0.1, *gripper[1:]])
    assert env.step(np.zeros(7))[4]["stage"] == "reach"
    assert env.reset(seed=0)[1]["stage"] == "start"


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_success_read_from_an_observation_is_robosuites(env_id: str, envs: dict[str, Any]) -> None:
    env, task = envs[env_id], ROBOSUITE_TASKS[env_id]
    env.reset(seed=0)
    rng, layout = np.random.default_rng(1), task.layout("paper")
    answers = []
    for _ in range(60):
        low, high = ([-0.1, -0.1, 0.8], [0.1, 0.1, 0.9]) if task.name == "Lift" else ([0.05, 0.25, 0.75], [0.35, 0.55, 0.95])
        move_object(env, rng.uniform(low, high).tolist())
        state = np.concatenate([[0.0], env.data.qpos, env.data.qvel])
        observation = env.observe_state(state)
        answers.append(bool(env.simulation._check_success()))
        found = task.is_success(observation[None, layout["object"]], observation[None, layout["robot0_eef_pos"]])
        assert found.tolist() == [answers[-1]]
    assert 5 < sum(answers) < 55


def test_the_horizon_truncates_and_wrong_keywords_are_named() -> None:
    env = gym.make("SparseLift-v0", horizon=3)
    for _ in range(2):
        env.reset(seed=0)
        ends = [env.step(np.zeros(7, dtype=np.float32))[2:4] for _ in range(3)]
        assert ends == [(False, False), (False, False), (False, True)]
    env.close()
    for name, wrong in (("obs", "pixels"), ("horizon", 0), ("horizon", 2.5)):
        keywords: dict[str, Any] = {name: wrong}
        with pytest.raises(ValueError, match=rf"{name}={wrong!r} (is not one of paper|must be a whole number of at least 1)"):
            robosuite_tasks.SparseLiftEnv(**keywords)


def test_an_environment_survives_pickling() -> None:
    env = gym.make("SparsePickPlaceCan-v0", horizon=np.int64(7)).unwrapped
    copy = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(env.reset(seed=8)[0], copy.reset(seed=8)[0])
    assert copy.horizon == 7
    env.close()
    copy.close()


def test_it_runs_in_processes_of_its_own_as_in_this_one() -> None:
    apart = make_vec_env("sb3_actpc.envs:SparseLift-v0", 2, seed=3, vec_env_cls=SubprocVecEnv)  # type: ignore[arg-type]
    here = make_vec_env("SparseLift-v0", 2, seed=3)
    np.testing.assert_array_equal(apart.reset(), here.reset())
    for action in actions_of(5):
        actions = np.stack([action, -action])
        for mine, theirs in zip(apart.step(actions)[:3], here.step(actions)[:3], strict=True):
            np.testing.assert_array_equal(mine, theirs)
    apart.close()
    here.close()


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_200_resets_do_not_leak(env_id: str, envs: dict[str, Any]) -> None:
    env = envs[env_id]
    sizes = []
    for n in (20, 200):
        for _ in range(n):
            env.reset()
            env.step(np.zeros(7))
        with open("/proc/self/statm", encoding="ascii") as file:
            sizes.append(int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE"))
    assert sizes[1] - sizes[0] < 10e6


def test_making_a_task_says_nothing_and_leaves_the_choice_of_an_opengl_library_alone() -> None:
    """robosuite chooses one when it is imported, with which child processes may not find MuJoCo's."""
    code = "import gymnasium, os, sb3_actpc; gymnasium.make('SparseLift-v0').reset(); print(os.environ.get('MUJOCO_GL'))"
    plain = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=plain, check=True)
    assert "None" in result.stdout and "robosuite" not in result.stderr


def test_rendering_gives_an_image_of_the_moving_arm() -> None:
    code = (
        "from sb3_actpc.experiments.runs.video import choose_gl_backend\n"
        "print(choose_gl_backend())\n"
        "import gymnasium, numpy as np, sb3_actpc\n"
        f"env = gymnasium.make('{CAN}', render_mode='rgb_array'); env.reset(seed=0)\n"
        "first = env.render()\n"
        "for _ in range(5): env.step(np.ones(7, dtype=np.float32))\n"
        "second = env.render(); env.close()\n"
        "print(first.shape, first.dtype, float(first.std()) > 20, float(np.abs(first.astype(float) - second).mean()) > 0.5)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    if result.stdout.startswith("None"):
        pytest.skip("no OpenGL library works on this machine")
    assert result.stdout.splitlines()[-1] == "(384, 384, 3) uint8 True True", result.stderr
