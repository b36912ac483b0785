"""What ``sb3-actpc bench`` measures: one update, as a ratio to SB3's TD3, and one step of training, as a ratio to RLPD."""

import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

import torch as th
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.logger import configure

from sb3_actpc.actpc import ActPC
from sb3_actpc.experiments.runs.presets import preset, with_changes

TASK = "SparseHalfCheetah-v5"
N_OBSERVED, N_ACTIONS = 17, 6  # its sizes
BATCH_SIZE, WIDTH, N_FILLED = 256, 256, 1000  # of one update
N_STEPS = 50  # environment steps of one measurement of training
N_UPDATES, N_CRITICS, STEP_BATCH = 4, 2, 128  # of one step of training, ActPC's defaults and rlpd.yml's
N_WARM_UP = 3  # rounds that do not count
# preset -> what shortens the training before the first step
QUICK: dict[str, dict[str, Any]] = {
    "actpc": {"signal_kwargs.prior_updates": 1, "guidance_kwargs.bc_updates": 1, "guidance_kwargs.critic_warmup": 1},
    "actpc_paper": {"signal_kwargs.prior_updates": 1},
}

Entries = dict[str, Callable[[], object]]


def measure(entries: Entries, rounds: int) -> dict[str, float]:
    """The median ratio, round by round, of every entry's time to that of the first; the entries take turns."""
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
    """Of the seconds of every entry's rounds, the median ratio to the same round of the first."""
    base = next(iter(times.values()))
    return {name: statistics.median(a / b for a, b in zip(own, base, strict=True)) for name, own in times.items()}


def updates() -> Entries:
    """Two updates of each learner (TD3 moves its actor every other time), on random transitions; TD3's first."""
    shared: dict[str, Any] = {"learning_starts": 2 * N_STEPS, "batch_size": BATCH_SIZE, "buffer_size": 100 * N_FILLED}
    shared |= {"gradient_steps": 1, "device": "cpu", "seed": 0}
    models: dict[str, Any] = {"SB3 TD3": TD3("MlpPolicy", TASK, policy_kwargs={"net_arch": [WIDTH, WIDTH]}, **shared)}
    for name, quick in QUICK.items():
        models[f"ActPC, {name}.yml"] = ActPC(env=TASK, **{**with_changes(preset(TASK, name), quick), **shared})
    entries: Entries = {}
    for name, model in models.items():
        model.set_logger(configure(None, []))
        model.learn(2 * N_STEPS)
        model.learning_starts = 2 * N_FILLED
        model.learn(N_FILLED)
        entries[name] = partial(model.train, gradient_steps=2, batch_size=model.batch_size)
    return entries


def training() -> Entries:
    """Steps of the environment, each with four critic updates, two critics and batches of 128; RLPD (SBX's SAC with
    layer-normalized critics) first, or SB3's TD3 where ``sbx-rl`` is not installed. Last the matrix products alone."""
    shared: dict[str, Any] = {"learning_starts": 2 * N_STEPS, "batch_size": STEP_BATCH, "buffer_size": 100 * N_FILLED}
    shared |= {"gradient_steps": N_UPDATES, "device": "cpu", "seed": 0}
    net_arch = {"net_arch": [WIDTH, WIDTH]}
    models: dict[str, Any] = {}
    if find_spec("sbx"):
        from sb3_actpc.baselines import RLPD

        models["RLPD"] = RLPD("MlpPolicy", TASK, policy_kwargs={**net_arch, "n_critics": N_CRITICS}, **shared)
    models["SB3 TD3"] = TD3("MlpPolicy", TASK, policy_kwargs=net_arch, **shared)
    models["SB3 SAC"] = SAC("MlpPolicy", TASK, policy_kwargs=net_arch, **shared)
    models["ActPC, actpc.yml"] = ActPC(env=TASK, **{**with_changes(preset(TASK, "actpc"), QUICK["actpc"]), **shared})
    models["ActPC without demonstrations"] = ActPC("MlpPolicy", TASK, **shared)
    for model in models.values():
        model.set_logger(configure(None, []))
        model.learn(4 * N_STEPS)
    entries: Entries = {name: partial(model.learn, N_STEPS, reset_num_timesteps=False) for name, model in models.items()}
    return {**entries, "matrix products alone": matrix_products()}


def matrix_products() -> Callable[[], None]:
    """The matrix products of ``N_STEPS`` steps of ActPC with demonstrations, which bound its time from below."""
    actor = [N_OBSERVED, WIDTH, WIDTH, N_ACTIONS]
    critic = [N_OBSERVED + N_ACTIONS, WIDTH, WIDTH, N_ACTIONS]

    def forward(sizes: Sequence[int], members: int, rows: int = STEP_BATCH) -> list[tuple[int, ...]]:
        return [(members, rows, n_in, n_out) for n_in, n_out in pairwise(sizes)]

    def backward(sizes: Sequence[int], members: int, to_inputs: bool = False) -> list[tuple[int, ...]]:
        """Errors of all layers but the inputs, or of these too."""
        layers = list(pairwise(sizes)) if to_inputs else list(pairwise(sizes))[1:]
        return [(members, STEP_BATCH, n_out, n_in) for n_in, n_out in layers]

    def change(sizes: Sequence[int], members: int) -> list[tuple[int, ...]]:
        return [(members, n_out, STEP_BATCH, n_in) for n_in, n_out in pairwise(sizes)]

    of_critic = [*forward(actor, 1), *forward(critic, N_CRITICS)]  # the targets
    of_critic += [*forward(critic, N_CRITICS), *backward(critic, N_CRITICS), *change(critic, N_CRITICS)]
    imitation = [*forward(actor, 1), *backward(actor, 1), *change(actor, 1)]
    q_filter = forward(critic, N_CRITICS, 2 * STEP_BATCH)
    critic_term = [*forward(critic, N_CRITICS), *backward(critic, N_CRITICS, to_inputs=True), *imitation]
    shapes = N_UPDATES * of_critic + imitation + q_filter + critic_term
    pairs = {one: (th.rand(one[0], *one[1:3]), th.rand(one[0], *one[2:])) for one in shapes}

    def multiply() -> None:
        for _ in range(N_STEPS):
            for shape in shapes:
                th.bmm(*pairs[shape])

    return multiply
