"""A run that is stopped and resumed is, bit for bit, the run that was never stopped."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

import sb3_actpc.envs  # noqa: F401, registers the sparse tasks
from sb3_actpc import ActPC
from sb3_actpc.baselines import IBRL
from sb3_actpc.checkpoints import CheckpointCallback, continue_learning, restore
from tests.actpc.envs import CountingEnv, demonstrations
from tests.checkpoints.runs import (
    ACTPC,
    SMALL,
    START_METHOD,
    assert_equal,
    assert_same,
    learn_in_two,
    learn_straight,
    log_rows,
    make_actpc,
)

REMEMBERING = {"net_arch": [16, 16], "memory_history": 3}
NOISE = {"action_noise": NormalActionNoise(np.zeros(2), 0.2 * np.ones(2))}
KEPT_ONCE = {"handle_timeout_termination": False}
HINDSIGHT = {"replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": {"copy_info_dict": True}}


class ContinuousBitFlipping(BitFlippingEnv):
    """SB3's with a Box of actions, as ActPC and TD3 need."""

    def __init__(self) -> None:
        super().__init__(n_bits=3, continuous=True, max_steps=4)
        assert isinstance(self.action_space, spaces.Box)


class HoldingEnv(gym.Env):
    """Episodes of 25 steps in a simulator that is itself an environment."""

    def __init__(self, simulator: gym.Env) -> None:
        self.env, self.count = simulator, 0
        self.observation_space, self.action_space = simulator.observation_space, simulator.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.count = 0
        return self.env.reset(seed=seed)

    def step(self, action: np.ndarray) -> Any:
        self.count += 1
        observation, reward, terminated, _, info = self.env.step(action)
        return observation, reward, terminated, self.count >= 25, info


def held(env_id: str) -> gym.Env:
    return gym.wrappers.TimeLimit(HoldingEnv(HoldingEnv(gym.make(env_id))), 20)


class Counted(VecEnvWrapper):
    """Rewards grow with the number of steps."""

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.n_steps = 0

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        self.n_steps += 1
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards + 0.01 * self.n_steps, dones, infos


class Skipping(VecNormalize):
    """Leaves out of checkpoints an attribute that it does not have, and a wrapper around it has."""

    checkpoint_skipped = ("n_steps",)


def make_sb3(algorithm: Any, env: Any = CountingEnv, n_envs: int = 1, wrappers: Any = (), **keywords: Any) -> Any:
    vec_env: Any = make_vec_env(env, n_envs=n_envs)
    for wrapper in wrappers:
        vec_env = wrapper(vec_env)
    policy = "MultiInputPolicy" if isinstance(vec_env.observation_space, spaces.Dict) else "MlpPolicy"
    return algorithm(policy, vec_env, **deepcopy({"buffer_size": 200, **SMALL, **keywords}))


def check(make: Any, folder: Path, n_steps: int, stop_at: int) -> Any:
    """Compare agents and logs of the run that was stopped and the one that was not."""
    straight = learn_straight(make, folder / "straight", n_steps)
    resumed = learn_in_two(make, folder / "resumed", n_steps, stop_at)
    assert_same(straight, resumed)
    assert log_rows(folder / "straight" / "progress.csv") == log_rows(folder / "resumed" / "progress.csv")
    return straight


# the episodes have 5, 9, 3 and 12 steps: 34 is (with one environment) an end, 41 is not
@pytest.mark.parametrize(
    ("stop_at", "keywords"),
    [
        (34, {}),
        (41, {"normalize": True}),
        (34, {"normalize": True, "n_envs": 2}),
        (41, {"n_envs": 2}),
        (41, {"guidance": "none", "guidance_kwargs": None, "train_freq": (1, "episode"), "gradient_steps": 2}),
        (41, {"buffer_size": 20, "action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(2), 0.1 * np.ones(2))}),
        (41, {"settling": "iterative", "policy_kwargs": {"net_arch": [16, 16], "circuit_kwargs": {"feedback": "tied"}}}),
        (41, {"n_steps": 3, "signal_kwargs": {"normalizer": "quantile", "prior_updates": 5}, "target_policy_noise": 0.0}),
        (41, {"n_steps": 4, "policy_kwargs": REMEMBERING}),
        (41, {"optimize_memory_usage": True, "replay_buffer_kwargs": KEPT_ONCE, "reward_weights": {}}),
        (41, {"demonstration_fraction": 0.0, "guidance_kwargs": {"gate": False}, "observation_normalization": "none"}),
        (41, {"tau": 1.0, "target_update_interval": 7, "train_freq": (3, "step"), "gradient_steps": -1}),
    ],
    ids=str,
)
def test_actpc(tmp_path: Path, stop_at: int, keywords: dict[str, Any]) -> None:
    check(lambda: make_actpc(CountingEnv, demonstrations=demonstrations(), **keywords), tmp_path, 90, stop_at)
    assert len(log_rows(tmp_path / "resumed" / "progress.csv")) > 8


RUNS = {
    "dictionaries": lambda: make_actpc(lambda: CountingEnv(dict_observations=True), policy="MultiInputPolicy"),
    "hindsight": lambda: make_sb3(ActPC, ContinuousBitFlipping, 2, **{**ACTPC, **HINDSIGHT, "buffer_size": 48}),
    "TD3 with hindsight": lambda: make_sb3(TD3, ContinuousBitFlipping, **{**HINDSIGHT, "buffer_size": 24}),
    "TD3": lambda: make_sb3(TD3, n_envs=2, wrappers=[VecNormalize], **NOISE),
    "DDPG": lambda: make_sb3(DDPG, n_envs=2, wrappers=[VecNormalize], **NOISE),
    "SAC": lambda: make_sb3(SAC, n_envs=2, wrappers=[VecNormalize]),
    "gSDE": lambda: make_sb3(SAC, n_envs=2, wrappers=[VecNormalize], use_sde=True, sde_sample_freq=4),
    "TQC": lambda: make_sb3(TQC, n_envs=2, wrappers=[VecNormalize]),
    "TD3 with a wrapper around VecNormalize": lambda: make_sb3(TD3, n_envs=2, wrappers=[Skipping, Counted]),
    "ActPC with one": lambda: make_sb3(ActPC, n_envs=2, wrappers=[Skipping, Counted], **ACTPC),
    "a simulator that is held": lambda: make_sb3(TD3, lambda: held("Pendulum-v1")),
    "MuJoCo that is held": lambda: make_sb3(TD3, lambda: held("SparseReacher-v5")),
}


@pytest.mark.parametrize("make", RUNS.values(), ids=RUNS)
def test_a_stopped_run_is_the_run_never_stopped(tmp_path: Path, make: Any) -> None:
    check(make, tmp_path, 80, 41)


@pytest.mark.parametrize(("n_envs", "stop_at"), [(1, 60), (2, 2)])
def test_the_gate_goes_on_among_its_decisions(tmp_path: Path, n_envs: int, stop_at: int) -> None:
    """Before the first episode has ended there is no worst return yet."""
    settings = {"critic_warmup": 0, "challenger_interval": 0, "bc_updates": 5}
    make = lambda: make_actpc(CountingEnv, n_envs, demonstrations=demonstrations(), guidance_kwargs=settings)  # noqa: E731
    gate = check(make, tmp_path, 240, stop_at).actor_guidance.logs()
    assert gate["policies_promoted"] + gate["policies_rejected"] > 0


@pytest.mark.parametrize(
    ("env_id", "stop_at"), [("SparseReacher-v5", 71), ("SparseHopper-v4", 71), ("HalfCheetah-v5", 51), ("Pendulum-v1", 231)]
)
def test_the_simulator_goes_on_in_the_middle_of_an_episode(tmp_path: Path, env_id: str, stop_at: int) -> None:
    check(lambda: make_actpc(env_id, learning_starts=20, normalize=True), tmp_path, stop_at + 30, stop_at)


class LateEnv(CountingEnv):
    """Makes a simulator in each reset, and holds what nobody can store."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.sim, self.handle = CountingEnv(), iter([1, 2, 3])
        return super().reset(seed=seed, options=options)


@pytest.mark.parametrize("algorithm", [ActPC, TD3])
def test_an_episode_that_cannot_be_restored_starts_again_and_the_log_says_so(tmp_path: Path, algorithm: Any) -> None:
    make = lambda: make_sb3(algorithm, LateEnv, **(ACTPC if algorithm is ActPC else {}))  # noqa: E731
    reason = "LateEnv.sim: it was .*CountingEnv, and is .*NoneType when made again; LateEnv.handle: a .*list_iterator"
    with pytest.warns(UserWarning, match=f"environments cannot be restored within their episodes.*{reason}"):
        resumed = learn_in_two(make, tmp_path, 60, 33)
    assert resumed.num_timesteps == 60
    assert resumed.replay_buffer.observations[33, 0, 1] == 0.0  # the first observation of an episode


def test_sb3s_evaluation_callback_remembers_its_best_and_its_rows(tmp_path: Path) -> None:
    make = lambda: make_actpc("Pendulum-v1", learning_starts=20)  # noqa: E731

    def evaluation(folder: Path) -> EvalCallback:
        env = make_vec_env("Pendulum-v1", seed=5, env_kwargs={"max_episode_steps": 20})
        return EvalCallback(env, n_eval_episodes=1, eval_freq=40, log_path=str(folder), verbose=0)

    learn_straight(make, tmp_path / "one", 130, evaluation(tmp_path / "one"))
    learn_in_two(make, tmp_path / "two", 130, 90, more=lambda: [evaluation(tmp_path / "two")])
    results = [dict(np.load(tmp_path / name / "evaluations.npz")) for name in ("one", "two")]
    assert_equal(*results, "evaluations")
    assert len(results[0]["timesteps"]) == 3


@pytest.mark.parametrize("stop_at", [10, 41])
def test_a_bc_policy_is_trained_once(tmp_path: Path, stop_at: int) -> None:
    """Also where the run stops before its first update."""
    policy_kwargs = {"net_arch": [8], "n_critics": 3}
    given: dict[str, Any] = {"bc_steps": 20, "learning_starts": 20, "policy_kwargs": policy_kwargs}
    given |= {"demonstrations": demonstrations(), "actor_kwargs": {"optimizer": "adamw"}}
    make = lambda: make_sb3(IBRL, **given)  # noqa: E731
    check(make, tmp_path, 70, stop_at)


def test_a_run_that_a_callback_stopped_goes_on_from_its_checkpoint_as_without_one(tmp_path: Path) -> None:
    def make() -> ActPC:
        return make_actpc(CountingEnv, 2, normalize=True, demonstrations=demonstrations(), policy_kwargs=REMEMBERING)

    straight = make().learn(90, callback=StopTrainingOnMaxEpisodes(2))
    straight.learn(90 - straight.num_timesteps, reset_num_timesteps=False)
    make().learn(90, callback=[StopTrainingOnMaxEpisodes(2), CheckpointCallback(tmp_path)])
    resumed = make()
    continue_learning(restore(resumed, tmp_path), CheckpointCallback(tmp_path))
    assert resumed.num_timesteps == 90
    assert_same(straight, resumed)


def test_environments_in_other_processes_start_again_from_seeded_states(tmp_path: Path) -> None:
    def make() -> TD3:
        env = make_vec_env("Pendulum-v1", 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": START_METHOD})
        return TD3("MlpPolicy", env, buffer_size=200, **deepcopy(SMALL))

    results = []
    for name in ("one", "two"):
        with pytest.warns(UserWarning, match="all episodes start again: SubprocVecEnv.remotes"):
            results.append(learn_in_two(make, tmp_path / name, 80, 40))
        results[-1].env.close()
    assert_same(*results)
