"""Runs that are stopped and resumed, and the comparison with the run that was never stopped."""

from __future__ import annotations

import csv
import multiprocessing
import signal
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import VecNormalize

from sb3_actpc import ActPC
from sb3_actpc.checkpoints import CheckpointCallback, TrainingStopped, continue_learning, restore
from sb3_actpc.checkpoints.state import buffer_arrays

WALL_TIME = {"time/fps", "time/time_elapsed", "seconds", "evaluation_seconds"}
# a forked process has imported everything already
START_METHOD = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"
MakeModel = Callable[[], OffPolicyAlgorithm]
SMALL: dict[str, Any] = {"policy_kwargs": {"net_arch": [16, 16]}, "learning_starts": 10, "batch_size": 16, "seed": 3}
# every circuit has a role; what is not said is the recipe of the constructor's defaults
SIGNALS: dict[str, Any] = {"reward_weights": {"epistemic": 0.5, "instrumental": 0.5}, "signal_kwargs": {"prior_updates": 5}}
ACTPC: dict[str, Any] = {**SMALL, **SIGNALS, "buffer_size": 200, "device": "cpu"}
SHORT_WARM_UP: dict[str, Any] = {"guidance_kwargs": {"bc_updates": 3, "critic_warmup": 5}}  # with demonstrations


def make_actpc(env: Any, n_envs: int = 1, normalize: bool = False, **keywords: Any) -> ActPC:
    vec_env: Any = make_vec_env(env, n_envs=n_envs)
    if normalize:
        vec_env = VecNormalize(vec_env, gamma=0.9)
    keywords = {**(SHORT_WARM_UP if "demonstrations" in keywords else {}), **keywords}
    return ActPC(keywords.pop("policy", "MlpPolicy"), vec_env, **deepcopy({**ACTPC, **keywords}))


class Terminate(BaseCallback):
    """SIGTERM to its own process, at the first step from one on."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step
        self.is_sent = False

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.step and not self.is_sent:
            self.is_sent = True
            signal.raise_signal(signal.SIGTERM)
        return True


def learn_straight(make: MakeModel, folder: Path, n_steps: int, *more: BaseCallback) -> OffPolicyAlgorithm:
    """The run that is never stopped, and never saved either."""
    model = make()
    model.set_logger(configure(str(folder), ["csv"]))
    return model.learn(n_steps, callback=[*more], log_interval=1)


def learn_in_two(
    make: MakeModel, folder: Path, n_steps: int, stop_at: int, more: Callable[[], list[BaseCallback]] = list
) -> OffPolicyAlgorithm:
    """The run that is stopped at a step and resumed by a new agent."""
    first = make()
    first.set_logger(configure(str(folder), ["csv"]))
    checkpoints = folder / "checkpoints"
    try:
        first.learn(n_steps, callback=[*more(), Terminate(stop_at), CheckpointCallback(checkpoints)], log_interval=1)
        raise AssertionError("the run was not stopped")
    except TrainingStopped as stopped:
        assert stopped.num_timesteps >= stop_at
    second = make()
    np.random.random(13)
    th.randn(7)
    second.action_space.sample()
    second.set_logger(configure(str(folder), ["csv"]))
    restored = restore(second, checkpoints)
    return continue_learning(restored, [*more(), CheckpointCallback(checkpoints)], log_interval=1)


def assert_same(one: OffPolicyAlgorithm, other: OffPolicyAlgorithm) -> None:
    """Weights, optimisers, buffers, counters, normalisers and the next numbers of the generators are equal bit for bit."""
    for name in one._get_torch_save_params()[0]:
        assert_equal(recursive_getattr(one, name).state_dict(), recursive_getattr(other, name).state_dict(), name)
    for name in one._get_torch_save_params()[1]:
        assert_equal(recursive_getattr(one, name), recursive_getattr(other, name), name)
    assert one.replay_buffer is not None and other.replay_buffer is not None
    assert (one.replay_buffer.pos, one.replay_buffer.full) == (other.replay_buffer.pos, other.replay_buffer.full)
    arrays = buffer_arrays(other.replay_buffer)
    for name, array in buffer_arrays(one.replay_buffer).items():
        assert_equal(array, arrays[name], name)
    for name in ("num_timesteps", "_n_updates", "_episode_num", "_total_timesteps", "_last_obs", "_last_original_obs"):
        assert_equal(getattr(one, name), getattr(other, name), name)
    rewards = [[(info["r"], info["l"]) for info in model.ep_info_buffer or ()] for model in (one, other)]
    assert rewards[0] == rewards[1]
    mine, theirs = one.get_vec_normalize_env(), other.get_vec_normalize_env()
    if mine is not None and theirs is not None:
        for name in ("obs_rms", "ret_rms", "returns", "old_obs", "old_reward"):
            assert_equal(_plain(getattr(mine, name)), _plain(getattr(theirs, name)), name)
    if hasattr(one, "checkpoint_state"):
        assert_equal(one.checkpoint_state(), other.checkpoint_state(), "own state")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    return dict(vars(value)) if hasattr(value, "var") and not isinstance(value, np.ndarray) else value


def assert_equal(one: Any, other: Any, where: str) -> None:
    """Equal bit for bit, through dictionaries, lists and tuples."""
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key, value in one.items():
            assert_equal(value, other[key], f"{where}.{key}")
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other), where
        for index, (mine, theirs) in enumerate(zip(one, other, strict=True)):
            assert_equal(mine, theirs, f"{where}.{index}")
    elif isinstance(one, th.Tensor):
        assert th.equal(one, other), where
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype and one.tobytes() == other.tobytes(), where
    else:
        assert one == other, where


def log_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file without the columns that measure time."""
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [{key: value for key, value in row.items() if key not in WALL_TIME and value} for row in rows]
