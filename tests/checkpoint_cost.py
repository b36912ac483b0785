"""What a checkpoint of a full HalfCheetah buffer costs, against ``numpy.save`` with fsync of the same arrays.

    python tests/checkpoint_cost.py

Prints both times (median of several, in turns), their ratio, and by how much writing a checkpoint raised the peak of memory.
"""

import argparse
import os
import resource
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_actpc import ActPC
from sb3_actpc.checkpoints import CheckpointCallback
from sb3_actpc.checkpoints.state import buffer_arrays


def full_agent(n_transitions: int) -> OffPolicyAlgorithm:
    """An agent of the default size whose buffer holds so many transitions of random numbers."""
    model = ActPC("MlpPolicy", make_vec_env("HalfCheetah-v5"), buffer_size=n_transitions, learning_starts=100, seed=0)
    model.learn(300)
    assert model.replay_buffer is not None
    generator = np.random.default_rng(0)
    for array in buffer_arrays(model.replay_buffer).values():
        for rows in np.array_split(array, 100):
            rows[...] = generator.random(rows.shape)
    model.replay_buffer.full = True
    return model


def plain_seconds(model: OffPolicyAlgorithm, folder: Path) -> float:
    """``numpy.save`` and fsync of the buffer's arrays."""
    assert model.replay_buffer is not None
    folder.mkdir()
    started = time.perf_counter()
    for name, array in buffer_arrays(model.replay_buffer).items():
        with open(folder / f"{name}.npy", "wb") as file:
            np.save(file, array)
            file.flush()
            os.fsync(file.fileno())
    seconds = time.perf_counter() - started
    shutil.rmtree(folder)
    return seconds


def checkpoint_seconds(callback: CheckpointCallback) -> float:
    """A whole checkpoint, from the agent's memory to its name on the disk."""
    started = time.perf_counter()
    path = callback.save()
    seconds = time.perf_counter() - started
    shutil.rmtree(path)
    return seconds


def peak_megabytes() -> float:
    """Most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> int:
    """:return: exit code, 1 when the checkpoint takes more than twice as long"""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--transitions", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    model = full_agent(args.transitions)
    assert model.replay_buffer is not None
    size = sum(array.nbytes for array in buffer_arrays(model.replay_buffer).values()) / 2**20
    with tempfile.TemporaryDirectory() as name:
        callback = CheckpointCallback(Path(name) / "checkpoints", handle_signals=False)
        callback.init_callback(model)
        before = peak_megabytes()
        checkpoint_seconds(callback)
        raised = peak_megabytes() - before
        plain, checkpoint = [], []
        for _ in range(args.repeats):
            plain.append(plain_seconds(model, Path(name) / "plain"))
            checkpoint.append(checkpoint_seconds(callback))
    ratio = statistics.median(checkpoint) / statistics.median(plain)
    print(f"buffer of {args.transitions} transitions: {size:.0f} MiB")
    print(f"numpy.save and fsync: {statistics.median(plain):.2f} s ({', '.join(f'{value:.2f}' for value in plain)})")
    print(f"checkpoint: {statistics.median(checkpoint):.2f} s ({', '.join(f'{value:.2f}' for value in checkpoint)})")
    print(f"ratio {ratio:.2f}; the peak of memory rose by {raised:.0f} MiB")
    return int(ratio > 2.0)


if __name__ == "__main__":
    sys.exit(main())
