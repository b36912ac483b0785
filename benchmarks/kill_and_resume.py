"""Kill a training run (SIGKILL) at random moments, resume it each time, and compare its end with the run never stopped.

    python benchmarks/kill_and_resume.py --kills 30

Prints one line per kill and ends with exit code 0 when both runs are equal bit for bit: weights, optimisers, replay buffer,
normalisers, generators, simulators, evaluations and logs (times of the clock left out).
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import safetensors.numpy
import torch as th
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import sb3_actpc.envs  # noqa: F401, registers the task
from sb3_actpc import ActPC
from sb3_actpc.checkpoints import CheckpointCallback, continue_learning, find_bundle, list_bundles, restore
from tests.checkpoints.runs import START_METHOD, log_rows

PROCESSES: Any = multiprocessing.get_context(START_METHOD)
SAVE_FREQ = 10
# times of the clock, names of folders, and what a resumed run has logged otherwise
DIFFERENT = {"t", "episode_times", "log_path", "time/fps", "time/time_elapsed", "_num_timesteps_at_start", "logger"}


def train(folder: Path, n_steps: int, started: Connection) -> None:
    """The run: start it, or go on with it, to its end."""
    th.set_num_threads(1)
    env = VecNormalize(make_vec_env("SparseReacher-v5", n_envs=2, seed=0))
    model = ActPC(
        "MlpPolicy", env, settling="scheduled", policy_kwargs={"net_arch": [16, 16], "memory_history": 7},
        batch_size=16, buffer_size=500,
        learning_starts=20, seed=0, device="cpu",
    )  # fmt: skip
    evaluation = EvalCallback(
        VecNormalize(make_vec_env("SparseReacher-v5", seed=9), training=False, norm_reward=False),
        n_eval_episodes=1, eval_freq=60, log_path=str(folder), verbose=0,
    )  # fmt: skip
    checkpoints = CheckpointCallback(folder / "checkpoints", SAVE_FREQ, report=print)
    resumes = bool(list_bundles(folder / "checkpoints"))
    restored = restore(model, folder / "checkpoints", print) if resumes else None
    model.set_logger(configure(str(folder), ["csv"]))
    print(f"  learning from step {model.num_timesteps}", flush=True)
    started.send(model.num_timesteps)
    if restored is not None:
        continue_learning(restored, [checkpoints, evaluation], log_interval=1)
    else:
        model.learn(n_steps, [checkpoints, evaluation], log_interval=1)


def start(folder: Path, n_steps: int) -> BaseProcess:
    """The run in a process of its own, returned once it learns."""
    receiver, sender = PROCESSES.Pipe(duplex=False)
    process = PROCESSES.Process(target=train, args=(folder, n_steps, sender))
    process.start()
    sender.close()
    try:
        receiver.recv()
    except EOFError:
        process.join()
        raise RuntimeError(f"the run ended with code {process.exitcode} before it learned") from None
    return process


def end_state(folder: Path) -> dict[str, Any]:
    """What the run has come to, without times of the clock and without names of folders."""
    bundle = find_bundle(folder / "checkpoints")
    state = json.loads((bundle.path / "state.json").read_bytes())
    nodes, arrays = state.pop("nodes"), safetensors.numpy.load_file(bundle.path / "arrays.safetensors")
    return {
        "files": {name: digest for name, digest in bundle.manifest["files"].items() if name.endswith(".npy")},
        "state": resolved(state, nodes, arrays),
        "progress": log_rows(folder / "progress.csv"),
        "steps": bundle.manifest["num_timesteps"],
    }


def resolved(value: Any, nodes: list[Any], arrays: dict[str, Any], within: tuple[int, ...] = ()) -> Any:
    """The state with each reference replaced by what it refers to, and without what differs between equal runs."""
    if isinstance(value, dict):
        if "array" in value:
            array = arrays[value["array"]]
            return value["kind"], str(array.dtype), array.shape, array.tobytes()
        if any(isinstance(one, list) and len(one) == 2 for one in value.get("items", ())):
            pairs = [pair for pair in value["items"] if pair[0] not in DIFFERENT]
            value = {**value, "items": [{"key": key, "value": part} for key, part in pairs]}
        return {key: resolved(part, nodes, arrays, within) for key, part in value.items() if key not in DIFFERENT}
    if isinstance(value, list) and len(value) == 1 and type(value[0]) is int:
        number = value[0]
        return number if number in within else resolved(nodes[number], nodes, arrays, (*within, number))
    return [resolved(part, nodes, arrays, within) for part in value] if isinstance(value, list) else value


def differences(one: Any, two: Any, path: str = "") -> list[str]:
    """Where two nested values of plain types differ."""
    if isinstance(one, dict) and isinstance(two, dict):
        parts = [(key, one.get(key), two.get(key)) for key in {**one, **two}]
    elif isinstance(one, list) and isinstance(two, list) and len(one) == len(two):
        parts = [(number, *pair) for number, pair in enumerate(zip(one, two, strict=True))]
    else:
        return [] if one == two else [path]
    return [found for key, mine, theirs in parts for found in differences(mine, theirs, f"{path}/{key}")]


def run_to_the_end(folder: Path, n_steps: int) -> float:
    """:return: seconds that it learned"""
    process = start(folder, n_steps)
    started = time.perf_counter()
    process.join()
    assert process.exitcode == 0
    return time.perf_counter() - started


def kill_often(folder: Path, n_kills: int, n_steps: int, pauses: Iterator[float]) -> int:
    """Kill a run and go on with it until it has been killed so often, or ends.

    :return: how often it was killed
    """
    for killed in range(n_kills):
        process = start(folder, n_steps)
        process.join(next(pauses))
        if process.exitcode is not None:
            assert process.exitcode == 0
            return killed
        process.kill()
        process.join()
        print(f"killed {killed + 1}", flush=True)
    run_to_the_end(folder, n_steps)
    return n_kills


def kill_and_resume(folder: Path, n_kills: int, n_steps: int, seed: int) -> bool:
    """
    :param folder: where all runs go
    :param n_kills: how often; where a run ends before, another one is begun
    :param n_steps: environment steps of a run
    :param seed: of the moments
    :return: whether the killed runs are equal to the one never stopped
    """
    moments = random.Random(seed)
    (folder / "straight").mkdir()
    seconds = run_to_the_end(folder / "straight", n_steps)
    straight = end_state(folder / "straight")
    pauses = (moments.uniform(0.0, 2.0 * seconds / (n_kills + 1)) for _ in itertools.count())
    done, found = 0, []
    while done < n_kills:
        killed = Path(tempfile.mkdtemp(dir=folder))
        done += kill_often(killed, n_kills - done, n_steps, pauses)
        found += differences(straight, end_state(killed))
    for path in found:
        print(f"different: {path}")
    print(f"{done} kills, {n_steps} steps: {'NOT EQUAL' if found else 'equal'}")
    return not found


def main() -> int:
    """:return: exit code"""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        return 0 if kill_and_resume(Path(folder), args.kills, args.steps, args.seed) else 1


if __name__ == "__main__":
    sys.exit(main())
