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
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
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


def check(make: Any, folder: Path, n_steps: int, stop_at: int, **options: Any) -> None:
    """Compare agents and logs of the two runs."""
    straight = learn_straight(make, folder / "straight", n_steps)
    resumed = learn_in_two(make, folder / "resumed", n_steps, stop_at, **options)
    assert_same(straight, resumed)
    assert log_rows(folder / "straight" / "progress.csv") == log_rows(folder / "resumed" / "progress.csv")


@pytest.mark.parametrize(("n_envs", "normalize", "stop_at"), [(1, False, 34), (1, True, 41), (2, True, 34), (2, False, 41)])
def test_actpc(tmp_path: Path, n_envs: int, normalize: bool, stop_at: int) -> None:
    """The episodes have 5, 9, 3 and 12 steps: 34 is (with one environment) an end, 41 is not."""
    make = lambda: make_actpc(CountingEnv, n_envs, normalize, demonstrations=demonstrations())  # noqa: E731
    check(make, tmp_path, 90, stop_at)
    assert len(log_rows(tmp_path / "resumed" / "progress.csv")) > 8


@pytest.mark.parametrize(
    "keywords",
    [
        {"guidance": "none", "guidance_kwargs": None, "train_freq": (1, "episode"), "gradient_steps": 2},
        {"buffer_size": 20, "action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(2), 0.1 * np.ones(2))},
        {"settling": "iterative", "policy_kwargs": {"net_arch": [16, 16], "circuit_kwargs": {"feedback": "tied"}}},
        {"n_steps": 3, "signal_kwargs": {"normalizer": "quantile", "prior_updates": 5}, "target_policy_noise": 0.0},
        {"n_steps": 4, "policy_kwargs": REMEMBERING},
        {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}, "reward_weights": {}},
        {"demonstration_fraction": 0.0, "guidance_kwargs": {"gate": False}, "observation_normalization": "none"},
        {"tau": 1.0, "target_update_interval": 7, "train_freq": (3, "step"), "gradient_steps": -1},
    ],
    ids=lambda keywords: next(iter(keywords)),
)
def test_actpc_with(tmp_path: Path, keywords: dict[str, Any]) -> None:
    check(lambda: make_actpc(CountingEnv, demonstrations=demonstrations(), **keywords), tmp_path, 90, 41)


def test_actpc_with_dictionaries_of_observations(tmp_path: Path) -> None:
    make = lambda: make_actpc(lambda: CountingEnv(dict_observations=True), policy="MultiInputPolicy")  # noqa: E731
    check(make, tmp_path, 80, 41)


@pytest.mark.parametrize(("n_envs", "stop_at"), [(1, 60), (2, 2)])
def test_the_gate_goes_on_among_its_decisions(tmp_path: Path, n_envs: int, stop_at: int) -> None:
    """Before the first episode has ended there is no worst return yet."""
    settings = {"critic_warmup": 0, "challenger_interval": 0, "bc_updates": 5}
    make = lambda: make_actpc(CountingEnv, n_envs, demonstrations=demonstrations(), guidance_kwargs=settings)  # noqa: E731
    check(make, tmp_path, 240, stop_at)
    model = learn_straight(make, tmp_path / "again", 240)
    gate = model.actor_guidance.logs()
    assert gate["policies_promoted"] + gate["policies_rejected"] > 0


class ContinuousBitFlipping(BitFlippingEnv):
    """SB3's with a Box of actions, as ActPC and TD3 need."""

    def __init__(self) -> None:
        super().__init__(n_bits=3, continuous=True, max_steps=4)
        assert isinstance(self.action_space, spaces.Box)


@pytest.mark.parametrize(("algorithm", "n_envs"), [(ActPC, 2), (TD3, 1)])
def test_hindsight_replay(tmp_path: Path, algorithm: Any, n_envs: int) -> None:
    def make() -> Any:
        keywords = ACTPC if algorithm is ActPC else {**SMALL, "buffer_size": 200}
        buffer = {"replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": {"copy_info_dict": True}}
        env = make_vec_env(ContinuousBitFlipping, n_envs=n_envs)
        return algorithm("MultiInputPolicy", env, **deepcopy({**keywords, **buffer, "buffer_size": 24 * n_envs}))

    check(make, tmp_path, 80, 41)


NOISE = {"action_noise": NormalActionNoise(np.zeros(2), 0.2 * np.ones(2))}


@pytest.mark.parametrize(
    ("algorithm", "keywords"),
    [(TD3, NOISE), (DDPG, NOISE), (SAC, {}), (SAC, {"use_sde": True, "sde_sample_freq": 4}), (TQC, {})],
    ids=["TD3", "DDPG", "SAC", "SAC with state-dependent exploration", "TQC"],
)
def test_baselines(tmp_path: Path, algorithm: Any, keywords: dict[str, Any]) -> None:
    def make() -> Any:
        env = VecNormalize(make_vec_env(CountingEnv, n_envs=2))
        return algorithm("MlpPolicy", env, buffer_size=200, **deepcopy({**keywords, **SMALL}))

    check(make, tmp_path, 80, 41)


@pytest.mark.parametrize(
    ("env_id", "stop_at"), [("SparseReacher-v5", 71), ("SparseHopper-v4", 71), ("HalfCheetah-v5", 51), ("Pendulum-v1", 231)]
)
def test_the_simulator_goes_on_in_the_middle_of_an_episode(tmp_path: Path, env_id: str, stop_at: int) -> None:
    def make() -> Any:
        return make_actpc(env_id, learning_starts=20, normalize=True)

    check(make, tmp_path, stop_at + 30, stop_at)


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


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "SparseReacher-v5"])
def test_an_environment_that_is_held_goes_on_too(tmp_path: Path, env_id: str) -> None:
    """Stopped in the second episode."""
    make_env = lambda: gym.wrappers.TimeLimit(HoldingEnv(HoldingEnv(gym.make(env_id))), 20)  # noqa: E731
    check(lambda: TD3("MlpPolicy", make_vec_env(make_env), buffer_size=200, **deepcopy(SMALL)), tmp_path, 80, 33)


class LateEnv(CountingEnv):
    """Makes a simulator in each reset, and holds what nobody can store."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.sim, self.handle = CountingEnv(), iter([1, 2, 3])
        return super().reset(seed=seed, options=options)


@pytest.mark.parametrize("algorithm", [ActPC, TD3])
def test_an_episode_that_cannot_be_restored_starts_again_and_the_log_says_so(tmp_path: Path, algorithm: Any) -> None:
    def make() -> Any:
        return algorithm("MlpPolicy", make_vec_env(LateEnv), **deepcopy(ACTPC if algorithm is ActPC else SMALL))

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
    sizes = {"policy_kwargs": {"net_arch": [8], "n_critics": 3}, "batch_size": 8, "buffer_size": 200, "bc_steps": 20}
    sizes["actor_kwargs"] = {"optimizer": "adamw"}

    def make() -> IBRL:
        env = DummyVecEnv([CountingEnv])
        return IBRL("MlpPolicy", env, demonstrations=demonstrations(), learning_starts=20, seed=1, device="cpu", **sizes)

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
