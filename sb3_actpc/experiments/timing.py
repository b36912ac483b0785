"""What ``sb3-actpc bench`` measures, as ratios to SB3's TD3: one update, and one step of training."""

import statistics
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.logger import configure

from sb3_actpc.actpc import ActPC
from sb3_actpc.experiments.runs.presets import preset, with_changes

TASK = "SparseHalfCheetah-v5"
BATCH_SIZE, WIDTH, N_FILLED = 256, 256, 1000
N_STEPS = 50  # environment steps of one measurement of training
N_WARM_UP = 3  # rounds that do not count
BASE = "SB3 TD3"
# preset -> what shortens the training before the first step
QUICK: dict[str, dict[str, Any]] = {
    "actpc": {"signal_kwargs.prior_updates": 1, "guidance_kwargs.bc_updates": 1, "guidance_kwargs.critic_warmup": 1},
    "actpc_paper": {"signal_kwargs.prior_updates": 1},
}

Entries = dict[str, Callable[[], object]]


def measure(entries: Entries, rounds: int) -> dict[str, float]:
    """The median ratio, round by round, of every entry's time to that of ``BASE``; the entries take turns."""
    # with one thread the processor's time, which other programs hardly change
    clock = time.process_time if th.get_num_threads() == 1 else time.perf_counter
    times: dict[str, list[float]] = {name: [] for name in entries}
    for _ in range(rounds + N_WARM_UP):
        for name, entry in entries.items():
            start = clock()
            entry()
            times[name].append(clock() - start)
    return ratios({name: seconds[N_WARM_UP:] for name, seconds in times.items()})


def ratios(times: dict[str, list[float]]) -> dict[str, float]:
    """Of the seconds of every entry's rounds, the median ratio to the same round of ``BASE``."""
    base = times[BASE]
    return {name: statistics.median(a / b for a, b in zip(own, base, strict=True)) for name, own in times.items()}


def updates() -> Entries:
    """Two updates of each learner (TD3 moves its actor every other time), on random transitions."""
    entries: Entries = {}
    for name, model in _learners().items():
        model.learning_starts = 2 * N_FILLED
        model.learn(N_FILLED)
        entries[name] = partial(model.train, gradient_steps=2, batch_size=model.batch_size)
    return entries


def training() -> Entries:
    """Steps of the environment, each with one update; SBX's SAC where ``sbx-rl`` is installed."""
    learners = _learners()
    if find_spec("sbx"):
        import sbx

        learners["SBX SAC"] = sbx.SAC("MlpPolicy", TASK, batch_size=BATCH_SIZE, learning_starts=2 * N_STEPS, seed=0)
        learners["SBX SAC"].set_logger(configure(None, []))
    for model in learners.values():
        model.learn(2 * N_STEPS)
    return {name: partial(model.learn, N_STEPS, reset_num_timesteps=False) for name, model in learners.items()}


def _learners() -> dict[str, Any]:
    shared: dict[str, Any] = {"learning_starts": 2 * N_STEPS, "batch_size": BATCH_SIZE, "buffer_size": 100 * N_FILLED}
    shared |= {"gradient_steps": 1, "device": "cpu", "seed": 0}
    models: dict[str, Any] = {BASE: TD3("MlpPolicy", TASK, policy_kwargs={"net_arch": [WIDTH, WIDTH]}, **shared)}
    for name, quick in QUICK.items():
        models[f"ActPC, {name}.yml"] = ActPC(env=TASK, **{**with_changes(preset(TASK, name), quick), **shared})
    for model in models.values():
        model.set_logger(configure(None, []))
    return models
