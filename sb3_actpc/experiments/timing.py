"""What ``sb3-actpc bench`` measures, as ratios: updates, a settling, steps of training, acting, growth with sizes, memory."""

import copy
import json
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_actpc.actpc import ActPC
from sb3_actpc.actpc.buffers import CombinedReplayBuffer
from sb3_actpc.envs.robosuite_layouts import ROBOSUITE_TASKS
from sb3_actpc.experiments.report.tables import markdown
from sb3_actpc.experiments.runs.presets import preset, with_changes
from sb3_actpc.ngc import NGCCircuit

TASKS = ("SparseHopper-v5", "SparseHalfCheetah-v5")
TASK = TASKS[1]
BATCH_SIZE, WIDTH, N_FILLED = 256, 256, 1000
N_STEPS = 50  # environment steps of one measurement of training
N_ENV_STEPS = 20  # of one measurement of robosuite
N_WARM_UP = 3  # rounds that do not count
SWEEP = {"feedback": "learned", "feedback_start": "mirrored"}
QUICK = {"prior_updates": 1}
TD3_SIZES: dict[str, Any] = {"policy_kwargs": {"net_arch": [WIDTH, WIDTH]}, "batch_size": BATCH_SIZE}

Entries = dict[str, Callable[[], object]]
# what is timed in turns, and which of it the others (that follow) are divided by -> what their ratio is called then
Group = tuple[Entries, dict[str, str]]
Ratios = dict[str, tuple[float, str]]


def measure(groups: Iterable[Group], rounds: int, device: str) -> Ratios:
    """The ratios of all that is in the groups; entries of one group take turns."""
    found: Ratios = {}
    for entries, units in groups:
        found |= ratios(_interleave(entries, rounds, th.cuda.synchronize if device != "cpu" else lambda: None), units)
    return found


def _interleave(entries: Entries, rounds: int, synchronize: Callable[[], object]) -> dict[str, list[float]]:
    """Seconds of every entry's rounds; with one thread the processor's, which other programs hardly change."""
    clock = time.process_time if th.get_num_threads() == 1 and not th.cuda.is_initialized() else time.perf_counter
    times: dict[str, list[float]] = {name: [] for name in entries}
    for _ in range(rounds + N_WARM_UP):
        for name, entry in entries.items():
            synchronize()
            start = clock()
            entry()
            synchronize()
            times[name].append(clock() - start)
    return {name: seconds[N_WARM_UP:] for name, seconds in times.items()}


def ratios(times: dict[str, list[float]], units: dict[str, str]) -> Ratios:
    """Of every entry, the median ratio, round by round, to the entry before it that is a unit."""
    found, base, unit = {}, times[next(iter(units))], ""
    for name, own in times.items():
        if name in units:
            base, unit = own, units[name]
        found[name] = round(statistics.median(a / b for a, b in zip(own, base, strict=True)), 2), unit
    return found


def table(files: list[Path]) -> str:
    """A Markdown table of what ``--output`` wrote, such as one file for each number of threads: a column for each file.
    ValueError for one of another kind."""
    heads, columns = ["update, over its unit"], []
    for file in files:
        try:
            about = json.loads(file.read_text())
            columns.append({f"{name} / {unit}": f"{ratio:.2f}" for name, (ratio, unit) in about["ratios"].items()})
            size = about.get("batch_size", BATCH_SIZE)
            heads.append(f"{about['device']}, {about['threads']} threads{'' if size == BATCH_SIZE else f', batch {size}'}")
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            raise ValueError(f"{file}: not what `sb3-actpc bench --output` writes ({error!r})") from error
    rows = [[name, *(column.get(name, "") for column in columns)] for name in columns[0]]
    return markdown(pd.DataFrame(rows, columns=heads))


def updates(device: str, batch_size: int = BATCH_SIZE) -> Group:
    """TD3's; ActPC's with every kind of settling, and with the paper's preset."""
    kinds: dict[str, tuple[str, dict[str, Any]]] = {
        "tied sweep": ("scheduled", {"feedback": "tied"}),
        "learned sweep": ("scheduled", SWEEP),
        "iterative, default tolerance": ("iterative", SWEEP),
    }
    default = preset(TASK, "actpc")
    settings = {
        f"default, {kind}": with_changes(default, {"settling": settling, "policy_kwargs.circuit_kwargs": circuits})
        for kind, (settling, circuits) in kinds.items()
    }
    settings["paper preset"] = preset(TASK, "actpc_paper")
    shared: dict[str, Any] = {"learning_starts": 10 * N_FILLED, "buffer_size": 10 * N_FILLED, "device": device, "seed": 0}
    entries = {"SB3 TD3 train()": _updater(TD3("MlpPolicy", TASK, **{**TD3_SIZES, "batch_size": batch_size}, **shared))}
    for name, keywords in settings.items():
        own: dict[str, Any] = {"policy": "MlpPolicy", **keywords, **QUICK, "batch_size": batch_size, **shared}
        entries[name] = _updater(ActPC(env=TASK, **own))
    return entries, {"SB3 TD3 train()": "TD3"}


def _updater(model: OffPolicyAlgorithm) -> Callable[[], object]:
    """Fill the buffer with random actions; one call is then two updates (TD3 moves its actor every other time)."""
    model.set_logger(configure(None, []))
    model.learn(N_FILLED)
    return lambda: model.train(gradient_steps=2, batch_size=model.batch_size)


def settling(device: str, batch_size: int = BATCH_SIZE) -> Group:
    """One K = 10 settling of a tied circuit, and its matrix products alone."""
    circuit = NGCCircuit(23, 17, (WIDTH, WIDTH), feedback="tied", dynamics="state").to(device)
    x, target = th.randn(batch_size, 23, device=device), th.randn(batch_size, 17, device=device)
    alone = "matrix products of one settling"
    entries = {alone: _products(circuit, batch_size), "one settling, K = 10": lambda: circuit.settle(x, target)}
    return entries, {alone: "the products"}


def _products(circuit: NGCCircuit, batch: int, of_update: bool = False) -> Callable[[], object]:
    """The matrix products alone of a circuit of two hidden layers: of its settling, or of a whole update."""
    wide, narrow = circuit.weights[1:]
    hidden, output = (th.randn(batch, len(weights), device=weights.device) for weights in (wide, narrow))
    up, down, change = th.empty_like(hidden), th.empty_like(output), th.empty_like(wide)

    def products() -> None:
        for _ in range(circuit.n_settling_steps):
            th.mm(hidden, wide.t(), out=up)
            th.mm(hidden, narrow.t(), out=down)
            th.mm(output, narrow, out=up)
            th.mm(hidden, wide, out=up)
        if of_update:
            th.mm(hidden, wide.t(), out=up)  # the projection before
            th.mm(hidden.t(), hidden, out=change)  # the changes after

    return products


def training(device: str) -> list[Group]:
    """Every task's learners, one update for each environment step, batch and layers alike (SBX's where ``sbx-rl`` is
    installed); then TD3 and ActPC as each comes."""
    groups: list[Group] = []
    for task in TASKS:
        groups.append((_learners(task, device), {f"SB3 TD3, {task}": f"SB3 TD3's time for a step of {task}"}))
        own = f"SB3 TD3's own defaults, {task}"
        groups.append((_learners_as_they_come(task, device, own), {own: f"their time for a step of {task}"}))
    return groups


def _learners(task: str, device: str) -> Entries:
    shared: dict[str, Any] = {"learning_starts": 100, "buffer_size": 100 * N_FILLED, "seed": 0}
    same: dict[str, Any] = {"train_freq": 1, "gradient_steps": 1, **shared}
    shipped: dict[str, Any] = {**preset(task, "actpc"), **QUICK, **shared, "gradient_steps": 1, "policy_delay": 2}
    shipped["batch_size"] = BATCH_SIZE
    models: dict[str, OffPolicyAlgorithm] = {
        f"SB3 TD3, {task}": TD3("MlpPolicy", task, device=device, **TD3_SIZES, **same),
        f"ActPC, {task}": ActPC(env=task, device=device, **shipped),
    }
    if find_spec("sbx"):
        import sbx

        models[f"SBX TD3, {task}"] = sbx.TD3("MlpPolicy", task, **copy.deepcopy(TD3_SIZES), **same)
    return {name: _learner(model) for name, model in models.items()}


def _learners_as_they_come(task: str, device: str, own: str) -> Entries:
    shared: dict[str, Any] = {"learning_starts": 100, "buffer_size": 100 * N_FILLED, "seed": 0, "device": device}
    shipped = {**preset(task, "actpc"), **QUICK, **shared}
    ours: ActPC = ActPC(env=task, **shipped)
    return {own: _learner(TD3("MlpPolicy", task, **shared)), f"ActPC's own defaults, {task}": _learner(ours)}


def _learner(model: OffPolicyAlgorithm, n_envs: int = 1) -> Callable[[], object]:
    model.set_logger(configure(None, []))
    model.learn(2 * N_STEPS * n_envs)
    return lambda: model.learn(N_STEPS * n_envs, reset_num_timesteps=False)


def acting() -> Group:
    """One observation through a net of two hidden layers: NumPy's products, and ours on the way that collecting takes."""
    agent: ActPC = ActPC("MlpPolicy", TASK, device="cpu", seed=0)
    layers = [(w.numpy(), b.numpy()) for w, b in zip(agent.actor.circuit.weights, agent.actor.circuit.biases, strict=True)]
    observation = np.zeros((1, 17), dtype=np.float32)

    def by_numpy() -> np.ndarray:
        h = observation
        for weights, bias in layers[:-1]:
            h = np.clip(h @ weights.T + bias, 0.0, 6.0)
        return np.tanh(h @ layers[-1][0].T + layers[-1][1])

    circuit = agent.actor.circuit
    entries: Entries = {
        "NumPy, one observation": by_numpy,
        "the circuit, one observation": lambda: circuit.project(agent.inputs.tensor(observation)),
        "collecting, one observation": lambda: agent.actor.roll_out(observation, None, None, [circuit]),
        "predict(), one observation": lambda: agent.predict(observation),
    }
    return entries, {"NumPy, one observation": "NumPy's time"}


def growth() -> list[Group]:
    """What grows with K, width, batch and number of environments, over the smallest of its kind, and its matrix products."""
    groups: list[Group] = []
    for kind, values in {"K": (5, 10, 20, 40), "width": (128, 256, 512, 1024), "batch": (64, 256, 1024)}.items():
        whole: Entries = {}
        alone: Entries = {}
        for value in values:
            size = {"K": 10, "width": WIDTH, "batch": BATCH_SIZE, kind: value}
            circuit = NGCCircuit(24, 6, (size["width"],) * 2, dynamics="state", n_settling_steps=size["K"])
            whole[f"one update of eq. 1, {kind} = {value}"] = _circuit_update(circuit, size["batch"])
            alone[f"its products, {kind} = {value}"] = _products(circuit, size["batch"], of_update=True)
        groups.append((whole | alone, {next(iter(entries)): f"{kind} = {values[0]}" for entries in (whole, alone)}))
    several: Entries = {f"{N_STEPS} updates and steps, {n} environments": _environments(n) for n in (1, 4, 16)}
    return [*groups, (several, {next(iter(several)): "one environment"})]


def _circuit_update(circuit: NGCCircuit, batch: int) -> Callable[[], object]:
    x, target = th.randn(batch, 24), th.randn(batch, 6)
    circuit.optimizer = th.optim.Adam(circuit.parameter_groups(1e-4), fused=True)
    return lambda: circuit.apply_changes(circuit.hebbian_update(circuit.settle(x, target)))


def _environments(n: int) -> Callable[[], object]:
    keywords: dict[str, Any] = {"batch_size": BATCH_SIZE, "buffer_size": 100 * N_FILLED, "seed": 0}
    return _learner(ActPC("MlpPolicy", make_vec_env(TASK, n), device="cpu", gradient_steps=1, **keywords), n)


def memory_ratio() -> float:
    """Bytes of a HalfCheetah transition in our replay buffer over those in SB3's."""
    pair = spaces.Box(-np.inf, np.inf, (17,), np.float64), spaces.Box(-1.0, 1.0, (6,), np.float32)
    ours, theirs = (
        sum(value.nbytes for value in vars(kind(N_FILLED, *pair, device="cpu")).values() if isinstance(value, np.ndarray))
        for kind in (CombinedReplayBuffer, ReplayBuffer)
    )
    return ours / theirs


def robosuite(rounds: int) -> Iterator[str]:
    """A line for each task: steps and resets, interleaved with those of robosuite's own environment at its defaults;
    ImportError when robosuite is not installed."""
    for env_id, task in ROBOSUITE_TASKS.items():
        times = _interleave(_robosuite_entries(env_id, task.name), rounds, lambda: None)
        medians = {name: statistics.median(seconds) for name, seconds in times.items()}
        ratio, _ = ratios(times, {"our steps": ""})["robosuite's steps"]
        yield (
            f"{env_id}: {N_ENV_STEPS / medians['our steps']:.0f} steps/s, {ratio:.2f} x robosuite's own; "
            f"a reset takes {1000 * medians['our reset']:.1f} ms, robosuite's {1000 * medians['robosuite reset']:.0f} ms"
        )


def _robosuite_entries(env_id: str, name: str) -> Entries:
    from sb3_actpc.envs.robosuite_tasks import make_simulation

    env, theirs = gym.make(env_id, horizon=10**9), make_simulation(name, use_object_obs=True, hard_reset=True)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (N_ENV_STEPS, 7))
    return {
        "our steps": lambda: [env.step(action) for action in actions],
        "robosuite's steps": lambda: [theirs.step(action) for action in actions],
        "our reset": env.reset,
        "robosuite reset": theirs.reset,
    }
