"""The sparse MuJoCo tasks pay what they say, and are otherwise their base tasks."""

import dataclasses
import pickle
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_actpc import Demonstrations, shipped_demonstrations
from sb3_actpc.cli import build_parser
from sb3_actpc.envs import SPARSE_MUJOCO_IDS, dense_env_id, sparse_env_id
from tests.recordings import record

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date.*", "ignore:.*infinity.*")

REACHER_IDS = [env_id for env_id in SPARSE_MUJOCO_IDS if "Reacher" in env_id]
LOCOMOTION_IDS = [env_id for env_id in SPARSE_MUJOCO_IDS if "Reacher" not in env_id]
DISTANCES = {"HalfCheetah": 20.0, "Hopper": 2.0, "Walker2d": 2.0, "Swimmer": 1.0}
VELOCITIES = {"HalfCheetah": 3.5, "Hopper": 1.0, "Walker2d": 1.0, "Swimmer": 0.3}


def task_of(env_id: str) -> str:
    return dense_env_id(env_id).split("-")[0]


def still_step(env: gym.Env) -> tuple[float, bool, dict]:
    """Reward, termination and info of a step without any torque."""
    _, reward, terminated, _, info = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    return float(reward), terminated, info


def shift_x(env: gym.Env, shift: float, velocity: float = 0.0) -> None:
    """Move the body along x without its clock, and set its forward velocity."""
    simulator = env.unwrapped
    qpos, qvel = simulator.data.qpos.copy(), np.zeros_like(simulator.data.qvel)
    qpos[0] += shift
    qvel[0] = velocity
    simulator.set_state(qpos, qvel)


def place_target(env: gym.Env, distance: float) -> None:
    """Put a motionless Reacher's target at a distance from its fingertip."""
    simulator = env.unwrapped
    qpos = simulator.data.qpos.copy()
    qpos[2:4] = simulator.get_body_com("fingertip")[:2] + np.array([0.0, distance])
    simulator.set_state(qpos, np.zeros_like(simulator.data.qvel))


@pytest.mark.parametrize("env_id", SPARSE_MUJOCO_IDS)
def test_both_checkers_accept_the_task(env_id: str) -> None:
    env = gym.make(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gymnasium_check_env(env.unwrapped, skip_render_check=True)
        sb3_check_env(env)
    env.close()


@pytest.mark.parametrize("env_id", SPARSE_MUJOCO_IDS)
def test_dense_reward_and_observations_equal_the_base_tasks_step_for_step(env_id: str) -> None:
    env, base = gym.make(env_id), gym.make(dense_env_id(env_id))
    assert (env.observation_space, env.action_space) == (base.observation_space, base.action_space)
    assert env.spec is not None and base.spec is not None
    assert env.spec.max_episode_steps == base.spec.max_episode_steps
    observation, _ = env.reset(seed=3)
    base_observation, _ = base.reset(seed=3)
    np.testing.assert_array_equal(observation, base_observation)
    env.action_space.seed(3)
    for _ in range(120):
        action = env.action_space.sample()
        observation, reward, terminated, truncated, info = env.step(action)
        base_observation, base_reward, base_terminated, base_truncated, _ = base.step(action)
        np.testing.assert_array_equal(observation, base_observation)
        assert info["dense_reward"] == base_reward
        assert (terminated, truncated) == (base_terminated, base_truncated)
        assert reward in (0.0, 1.0)
        assert type(info["is_success"]) is bool
        if terminated or truncated:
            np.testing.assert_array_equal(env.reset(seed=4)[0], base.reset(seed=4)[0])
    env.close()
    base.close()


@pytest.mark.parametrize("env_id", REACHER_IDS)
@pytest.mark.parametrize(
    ("kwargs", "reach", "miss"), [({}, 0.06, 0.0), ({"miss_reward": -1.0, "threshold": 0.02}, 0.02, -1.0)]
)
def test_reacher_is_paid_near_the_target_only(env_id: str, kwargs: dict[str, float], reach: float, miss: float) -> None:
    env = gym.make(env_id, **kwargs)
    env.reset(seed=0)
    for distance in (0.05, 0.07, 0.01, 0.2):
        place_target(env, distance)
        reward, _, info = still_step(env)
        assert reward == (1.0 if distance < reach else miss), distance
        assert info["is_success"] is (distance < reach), distance
    env.close()


@pytest.mark.parametrize("env_id", LOCOMOTION_IDS)
@pytest.mark.parametrize("threshold", [None, 0.5])
def test_displacement_is_paid_on_every_step_beyond_the_threshold(env_id: str, threshold: float | None) -> None:
    distance = DISTANCES[task_of(env_id)] if threshold is None else threshold
    env = gym.make(env_id, threshold=threshold)
    env.reset(seed=0)
    shift_x(env, distance - 0.2)
    reward, _, info = still_step(env)
    assert (reward, info["is_success"]) == (0.0, False)
    shift_x(env, 0.4)
    for _ in range(3):
        reward, _, info = still_step(env)
        assert (reward, info["is_success"]) == (1.0, True)
    shift_x(env, -distance)
    reward, _, info = still_step(env)
    assert (reward, info["is_success"]) == (0.0, True), "success stays passed in this episode"
    env.close()


@pytest.mark.parametrize("env_id", LOCOMOTION_IDS)
def test_displacement_is_measured_from_each_resets_own_x(env_id: str) -> None:
    env = gym.make(env_id)
    env.unwrapped.init_qpos[0] = DISTANCES[task_of(env_id)] + 1.0  # episodes begin beyond the threshold's x
    env.reset(seed=1)
    reward, _, info = still_step(env)
    assert (reward, info["is_success"]) == (0.0, False)
    env.close()


@pytest.mark.parametrize("env_id", LOCOMOTION_IDS)
@pytest.mark.parametrize("threshold", [None, 0.0, 100.0])
def test_forward_is_paid_above_the_velocity_and_success_is_still_the_distance(env_id: str, threshold: float | None) -> None:
    """A threshold of 0 pays any motion forward, as the paper words it of Walker2d, Hopper and Swimmer."""
    velocity = VELOCITIES[task_of(env_id)] if threshold is None else threshold
    env = gym.make(env_id, condition="forward", threshold=threshold)
    env.reset(seed=0)
    for start in (-5.0, -0.5, 0.2, 8.0):
        shift_x(env, 0.0, start)
        reward, _, info = still_step(env)
        assert reward == float(info["x_velocity"] > velocity)
        assert (info["x_velocity"] > 0.0) == (start > 0.0)
        assert info["is_success"] is False
    assert reward == float(velocity < 8.0)
    shift_x(env, DISTANCES[task_of(env_id)] + 0.5, -1.0)
    reward, _, info = still_step(env)
    assert (reward, info["is_success"]) == (0.0, True)
    env.close()


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        *[
            (env_id, {"threshold": value})
            for env_id in (REACHER_IDS[0], LOCOMOTION_IDS[0])
            for value in (-1.0, np.nan, "far", True)
        ],
        (LOCOMOTION_IDS[0], {"condition": "sideways"}),
        (LOCOMOTION_IDS[0], {"condition": "forward", "threshold": -1.0}),
        *[(REACHER_IDS[0], {"miss_reward": value}) for value in (1.0, float("-inf"), "no", False)],
    ],
)
def test_bad_keywords_are_named_with_their_value(env_id: str, kwargs: dict[str, Any]) -> None:
    name, value = list(kwargs.items())[-1]
    with pytest.raises(ValueError, match=f"{name}={value!r} (must be a finite number, at least|is not one of .*displacement)"):
        gym.make(env_id, **kwargs)


@pytest.mark.parametrize("env_id", SPARSE_MUJOCO_IDS)
def test_a_pickled_task_keeps_its_keywords(env_id: str) -> None:
    kwargs = {"miss_reward": -1.0} if env_id in REACHER_IDS else {"condition": "forward", "reset_noise_scale": 0.0}
    env = gym.make(env_id, threshold=0.25, **kwargs)
    copy = pickle.loads(pickle.dumps(env.unwrapped))
    np.testing.assert_array_equal(copy.reset(seed=5)[0], env.reset(seed=5)[0])
    for action in np.linspace(-1.0, 1.0, 10):
        one = np.full(env.action_space.shape, action, np.float32)
        assert copy.step(one)[1] == env.step(one)[1]
    env.close()


def test_subprocesses_report_timeouts_and_success_to_sb3() -> None:
    # the module before the colon is imported in the subprocess, so this needs no installed entry point
    env_id, env_kwargs = "sb3_actpc.envs:SparseReacher-v5", {"miss_reward": -1.0}
    env = make_vec_env(env_id, n_envs=2, seed=0, vec_env_cls=SubprocVecEnv, env_kwargs=env_kwargs)
    env.reset()
    for _ in range(50):
        _, rewards, dones, infos = env.step(np.zeros((2, 2), dtype=np.float32))
        assert set(rewards.tolist()) <= {-1.0, 1.0}
    assert dones.all()
    assert all(info["TimeLimit.truncated"] is True for info in infos)
    assert [info["is_success"] for info in infos] == (rewards == 1.0).tolist()
    env.close()


def test_ids_of_other_forms_of_a_task() -> None:
    assert sparse_env_id("sb3_actpc.envs:GoalHopper-v5") == "sb3_actpc.envs:SparseHopper-v5"
    assert sparse_env_id("Goals:Other-v0") == "Goals:Other-v0"
    assert dense_env_id("SparseReacher-v4") == "Reacher-v4"
    for unknown in ("Hopper-v5", "SparseAnt-v5", "SparseHopper-v3", ""):
        with pytest.raises(ValueError, match=r"choose one of SparseReacher-v5, .*SparseSwimmer-v4"):
            dense_env_id(unknown)


@pytest.mark.parametrize("env_id", SPARSE_MUJOCO_IDS)
def test_demonstrations_recorded_under_one_condition_are_paid_as_live_under_another(env_id: str) -> None:
    """Otherwise the critic would learn two rewards at once: the demonstrations' and the environment's."""
    thresholds = {"Reacher": 0.2, "Walker2d": 1e-4, "Swimmer": 0.02}
    threshold = thresholds.get(task_of(env_id), 0.1)
    recorded = record(env_id, 10, 50)
    for kwargs in [{}] if "Reacher" in env_id else [{"condition": "displacement"}, {"condition": "forward"}]:
        live = record(env_id, 10, 50, threshold=threshold, **kwargs)
        env = make_vec_env(env_id, env_kwargs={"threshold": threshold, **kwargs})
        rewarded = recorded.rewarded_by(env)
        env.close()
        assert np.array_equal(rewarded.rewards, live.rewards)
        assert 0 < rewarded.rewards.sum() < len(rewarded)
        assert rewarded.observations is recorded.observations


@pytest.mark.parametrize(
    ("env_id", "weights"),
    [
        ("SparseHalfCheetah-v5", {"ctrl_cost_weight": 1.0}),
        ("SparseHalfCheetah-v5", {"forward_reward_weight": 2.0}),
        ("SparseHopper-v5", {"healthy_reward": 0.0}),
        ("SparseSwimmer-v5", {"ctrl_cost_weight": 1.0}),
    ],
)
@pytest.mark.parametrize("is_own", [False, True])
def test_demonstrations_are_paid_as_live_whatever_the_base_tasks_reward_weighs(
    env_id: str, weights: Any, is_own: bool
) -> None:
    """Recorded with the default weights, or with the environment's own."""
    options = {"condition": "forward", "threshold": 0.1}
    recorded, live = record(env_id, 5, 50, **(weights if is_own else {})), record(env_id, 5, 50, **options)
    env = make_vec_env(env_id, env_kwargs={**options, **weights})
    assert np.array_equal(recorded.rewarded_by(env).rewards, live.rewards)
    assert 0 < live.rewards.sum() < len(live)
    env.close()


@pytest.mark.parametrize(
    ("env_id", "change", "options"),
    [
        ("SparseHopper-v5", {"dense_rewards": None}, {"env_kwargs": {"condition": "forward"}}),
        # the environment's own method does not know what a wrapper makes of a reward
        (
            "SparseHopper-v5",
            {},
            {"wrapper_class": gym.wrappers.TransformReward, "wrapper_kwargs": {"func": lambda reward: reward - 1}},
        ),
        ("SparseReacher-v5", dict.fromkeys(("observations", "next_observations"), np.zeros((12, 8))), {}),
    ],
)
def test_demonstrations_whose_rewards_cannot_be_told_keep_them(env_id: str, change: Any, options: Any) -> None:
    recorded = dataclasses.replace(record(env_id, 1), rewards=np.full(12, 0.5), **change)
    env = make_vec_env(env_id, **options)
    assert np.array_equal(recorded.rewarded_by(env).rewards, recorded.rewards)
    env.close()


@pytest.mark.parametrize("command", [["evaluate", "RUN"], ["enjoy", "--env", "SparseHopper-v5"], ["card", "RUN"]])
def test_agents_are_shown_from_starts_that_no_demonstration_has(command: list[str]) -> None:
    seed = build_parser().parse_args(command).seed
    shown = Demonstrations.load(shipped_demonstrations("SparseHopper-v5"))
    starts = shown.observations[shown.episode_starts]
    env = gym.make("SparseHopper-v5")
    reset = np.array([env.reset(seed=seed + number)[0] for number in range(10)])
    assert np.abs(starts[:, None] - reset).max(axis=-1).min() > 1e-5
    env.close()
