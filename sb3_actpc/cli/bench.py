"""``sb3-actpc bench``: what one update costs, as ratios to SB3's TD3 and to the matrix products alone; by choice also what a
step of training or acting costs, and growth with sizes; with ``--robosuite``, robosuite tasks over robosuite's own loop."""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

TASK = "SparseHalfCheetah-v5"
BATCH_SIZE = 256
WIDTH = 256
N_FILLED = 1000
N_ENV_STEPS = 20
LEARNED = {"feedback": "learned", "feedback_start": "mirrored"}
TD3_UNIT = {"SB3 TD3 train()": "TD3"}  # the entry that others are divided by, and what their ratio is called then
SETTLING_UNIT = {"matrix products of one settling": "the products"}


def add_parser(subparsers: Any) -> None:
    """:param subparsers: what ``ArgumentParser.add_subparsers`` returned"""
    parser = subparsers.add_parser("bench", help="time one update of ActPC against SB3's TD3")
    parser.add_argument("--rounds", type=int, default=40, help="interleaved measurements of every entry")
    parser.add_argument("--threads", type=int, default=None, help="torch threads (default: torch's own choice)")
    parser.add_argument("--device", default="cpu", help="torch device")
    parser.add_argument("--compiled", action="store_true", help="also the compiled update (compiling takes minutes)")
    parser.add_argument("--training", action="store_true", help="also steps of training, and acting (SBX's with sbx-rl)")
    parser.add_argument("--growth", action="store_true", help="also growth with K, width, batch and number of environments")
    parser.add_argument("--output", type=Path, default=None, help="write the ratios to this JSON file")
    parser.add_argument("--table", type=Path, nargs="+", default=None, help="print written ratios as a Markdown table instead")
    parser.add_argument("--robosuite", action="store_true", help="time the robosuite tasks instead")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    Measure and print.

    :param args: the parsed command line
    :return: the exit code
    :raises ValueError: when a number is too small
    :raises ImportError: when ``--robosuite`` is asked for and not installed
    """
    import torch as th

    if args.rounds < 1 or (args.threads is not None and args.threads < 1):
        raise ValueError(f"--rounds {args.rounds} and --threads {args.threads} must be at least 1")
    if args.table:
        print(table(args.table))
        return 0
    if args.threads is not None:
        th.set_num_threads(args.threads)
    if args.robosuite:
        _bench_robosuite(args.rounds)
        return 0
    ratios = _measured(args)
    print(f"batch {BATCH_SIZE}, hidden [{WIDTH}, {WIDTH}], {args.device}, {th.get_num_threads()} threads; medians of rounds")
    for name, (ratio, unit) in ratios.items():
        print(f"{name:56s} {ratio:6.2f} x {unit}")
    if args.output:
        about = {"device": args.device, "threads": th.get_num_threads(), "rounds": args.rounds, "torch": th.__version__}
        args.output.write_text(json.dumps({**about, "ratios": ratios}, indent=1) + "\n")
    print(f"replay memory over SB3's, per HalfCheetah transition: {_memory_ratio():.2f}")
    return 0


def _measured(args: argparse.Namespace) -> dict[str, tuple[float, str]]:
    """The ratios of all that was asked for; entries that share a unit take turns."""
    import torch as th

    from sb3_actpc.experiments import timing

    synchronize = th.cuda.synchronize if args.device != "cpu" else lambda: None
    groups = [(_updates(args.device, args.compiled), TD3_UNIT), (_settling(args.device), SETTLING_UNIT)]
    if args.training:
        groups += [*timing.training(args.device), (timing.acting(), timing.ACTING_UNIT)]
    if args.growth:
        groups += timing.growth()
    ratios: dict[str, tuple[float, str]] = {}
    for entries, units in groups:
        ratios |= _ratios(_interleave(entries, args.rounds, synchronize), units)
    return ratios


def _updates(device: str, compiled: bool) -> dict[str, Callable[[], object]]:
    """TD3's, those of :func:`_settings`, and the shipped one with products in bfloat16, where the processor has them."""
    from sb3_actpc.experiments.runs.presets import with_changes
    from sb3_actpc.ngc.products import has_bfloat16

    settings, shipped = _settings(), "shipped, learned sweep"
    low = {"policy_kwargs.circuit_kwargs.matmul_precision": "bfloat16"}
    if has_bfloat16():
        settings[f"{shipped}, bfloat16"] = with_changes(settings[shipped], low)
        settings["paper preset, bfloat16"] = with_changes(settings["paper preset"], low)
    for name in [name for name in settings if name.startswith(shipped) and compiled]:
        settings[f"{name}, compiled"] = {**settings[name], "compile": True}
    return {"SB3 TD3 train()": _stepper(_td3(device))} | {
        name: _stepper(_actpc(keywords, device)) for name, keywords in settings.items()
    }


def _settings() -> dict[str, dict[str, Any]]:
    """The agents measured: the bare one and the shipped one with every kind of settling, and the paper's preset."""
    from sb3_actpc.experiments.runs import preset
    from sb3_actpc.experiments.runs.presets import with_changes

    kinds: dict[str, tuple[str, dict[str, Any]]] = {
        "tied sweep": ("scheduled", {"feedback": "tied"}),
        "learned sweep": ("scheduled", LEARNED),
        "iterative, default tolerance": ("iterative", LEARNED),
    }
    agents = {"bare": {}, "shipped": preset(TASK, "actpc")}
    settings = {
        f"{name}, {kind}": with_changes(keywords, {"settling": settling, "policy_kwargs.circuit_kwargs": circuits})
        for name, keywords in agents.items()
        for kind, (settling, circuits) in kinds.items()
    }
    return {**settings, "paper preset": preset(TASK, "actpc_paper")}


def _td3(device: str) -> OffPolicyAlgorithm:
    from stable_baselines3 import TD3

    return TD3("MlpPolicy", TASK, policy_kwargs={"net_arch": [WIDTH, WIDTH]}, batch_size=BATCH_SIZE, **_common(device))


def _actpc(keywords: dict[str, Any], device: str) -> OffPolicyAlgorithm:
    from sb3_actpc import ActPC

    quick = {"prior_updates": 1, "actor_warm_start": 0, "critic_warmup": 0, "batch_size": BATCH_SIZE}
    return ActPC(env=TASK, **{"policy": "MlpPolicy", **keywords, **quick, **_common(device)})


def _common(device: str) -> dict[str, Any]:
    return {"learning_starts": 10 * N_FILLED, "buffer_size": 10 * N_FILLED, "device": device, "seed": 0}


def _stepper(model: OffPolicyAlgorithm) -> Callable[[], object]:
    """Fill the buffer with random actions; one call is then two updates (TD3 moves its actor every other time)."""
    from stable_baselines3.common.logger import configure

    model.set_logger(configure(None, []))
    model.learn(N_FILLED)
    return lambda: model.train(gradient_steps=2, batch_size=BATCH_SIZE)


def _settling(device: str) -> dict[str, Callable[[], object]]:
    """One K = 10 settling of a tied circuit, and its matrix products alone."""
    import torch as th

    from sb3_actpc.ngc import NGCCircuit

    circuit = NGCCircuit(23, 17, (WIDTH, WIDTH), feedback="tied", dynamics="state").to(device)
    x, target = th.randn(BATCH_SIZE, 23, device=device), th.randn(BATCH_SIZE, 17, device=device)
    hidden, output = th.randn(BATCH_SIZE, WIDTH, device=device), th.randn(BATCH_SIZE, 17, device=device)
    wide, narrow = circuit.weights[1], circuit.weights[2]
    up, down = th.empty_like(hidden), th.empty_like(output)

    def products() -> None:
        for _ in range(circuit.n_settling_steps):
            th.mm(hidden, wide.t(), out=up)
            th.mm(hidden, narrow.t(), out=down)
            th.mm(output, narrow, out=up)
            th.mm(hidden, wide, out=up)

    return {"matrix products of one settling": products, "one settling, K = 10": lambda: circuit.settle(x, target)}


def _interleave(
    entries: dict[str, Callable[[], object]], rounds: int, synchronize: Callable[[], object]
) -> dict[str, list[float]]:
    """Seconds of every entry's rounds; with one thread the processor's, which other programs hardly change."""
    import torch as th

    clock = time.process_time if th.get_num_threads() == 1 and not th.cuda.is_initialized() else time.perf_counter
    times: dict[str, list[float]] = {name: [] for name in entries}
    for round_number in range(rounds + 3):
        for name, entry in entries.items():
            synchronize()
            start = clock()
            entry()
            synchronize()
            if round_number >= 3:  # the first ones warm up
                times[name].append(clock() - start)
    return times


def _ratios(times: dict[str, list[float]], units: dict[str, str]) -> dict[str, tuple[float, str]]:
    """Of every entry, the median ratio, round by round, to the entry before it that is a unit."""
    ratios, base, unit = {}, times[next(iter(units))], ""
    for name, own in times.items():
        if name in units:
            base, unit = own, units[name]
        ratios[name] = round(statistics.median(a / b for a, b in zip(own, base, strict=True)), 2), unit
    return ratios


def table(files: list[Path]) -> str:
    """
    :param files: what ``--output`` wrote, such as one for each number of threads
    :return: a Markdown table, a row for each entry and a column for each file
    """
    measured = [json.loads(file.read_text()) for file in files]
    heads = [f"{about['device']}, {about['threads']} threads" for about in measured]
    lines = [f"| update, over its unit | {' | '.join(heads)} |", "| --- |" + " --- |" * len(heads)]
    for name, (_, unit) in measured[0]["ratios"].items():
        cells = [f"{about['ratios'][name][0]:.2f}" if name in about["ratios"] else "" for about in measured]
        lines.append(f"| {name} / {unit} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _bench_robosuite(rounds: int) -> None:
    """Steps and resets of both tasks, interleaved with those of robosuite's own environment at its defaults."""
    from sb3_actpc.envs.robosuite_layouts import ROBOSUITE_TASKS

    print(f"medians of {rounds} interleaved rounds of {N_ENV_STEPS} steps and a reset")
    for env_id, task in ROBOSUITE_TASKS.items():
        times = _interleave(_robosuite_entries(env_id, task.name), rounds, synchronize=lambda: None)
        medians = {name: statistics.median(values) for name, values in times.items()}
        ratio = statistics.median(a / b for a, b in zip(times["robosuite's steps"], times["our steps"], strict=True))
        print(
            f"{env_id}: {N_ENV_STEPS / medians['our steps']:.0f} steps/s, {ratio:.2f} x robosuite's own; "
            f"a reset takes {1000 * medians['our reset']:.1f} ms, robosuite's {1000 * medians['robosuite reset']:.0f} ms"
        )


def _robosuite_entries(env_id: str, name: str) -> dict[str, Callable[[], object]]:
    import gymnasium as gym
    import numpy as np

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


def _memory_ratio() -> float:
    import numpy as np
    from gymnasium import spaces
    from stable_baselines3.common.buffers import ReplayBuffer

    from sb3_actpc.actpc.buffers import CombinedReplayBuffer

    pair = spaces.Box(-np.inf, np.inf, (17,), np.float64), spaces.Box(-1.0, 1.0, (6,), np.float32)
    sizes = [
        sum(value.nbytes for value in vars(kind(N_FILLED, *pair, device="cpu")).values() if isinstance(value, np.ndarray))
        for kind in (CombinedReplayBuffer, ReplayBuffer)
    ]
    return sizes[0] / sizes[1]
