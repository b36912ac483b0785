"""What a checkpoint of a full HalfCheetah buffer costs, against ``numpy.save`` with fsync of the same arrays.

    python benchmarks/checkpoint_cost.py

Measures in turns, since the disk's speed changes: the plain files, and a checkpoint. Prints the medians of the times and of
their ratio, and by how much writing a checkpoint raised the peak of memory. Exit code 1 when a checkpoint takes more than
twice as long as the plain files, or memory rose by a tenth of the buffer.
"""

import argparse
import os
import resource
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
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
    overwrite(model, n_transitions)
    model.replay_buffer.full = True
    return model


def overwrite(model: OffPolicyAlgorithm, n_transitions: int) -> None:
    """Random numbers in so many rows from the cursor on, which moves behind them."""
    buffer = model.replay_buffer
    assert buffer is not None
    generator = np.random.default_rng()
    rows = np.arange(buffer.pos, buffer.pos + n_transitions) % buffer.buffer_size
    for array in buffer_arrays(buffer).values():
        for some in np.array_split(rows, 100):
            array[some] = generator.random((len(some), *array.shape[1:]))
    buffer.pos = (buffer.pos + n_transitions) % buffer.buffer_size


def save_plainly(model: OffPolicyAlgorithm, folder: Path) -> None:
    """``numpy.save`` and fsync of the buffer's arrays."""
    assert model.replay_buffer is not None
    folder.mkdir()
    for name, array in buffer_arrays(model.replay_buffer).items():
        with open(folder / f"{name}.npy", "wb") as file:
            np.save(file, array)
            file.flush()
            os.fsync(file.fileno())


def seconds_of(action: Callable[[], object]) -> float:
    """How long it takes."""
    started = time.perf_counter()
    action()
    return time.perf_counter() - started


def peak_megabytes() -> float:
    """Most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> int:
    """:return: exit code"""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--transitions", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--folder", type=Path, help="where to write (default: the system's temporary folder)")
    args = parser.parse_args()
    model = full_agent(args.transitions)
    assert model.replay_buffer is not None
    size = sum(array.nbytes for array in buffer_arrays(model.replay_buffer).values()) / 2**20
    times: dict[str, list[float]] = {"numpy.save and fsync": [], "checkpoint": []}
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        callback = CheckpointCallback(Path(name) / "checkpoints")
        callback.init_callback(model)
        callback.close()  # Ctrl-C stops at once
        before = peak_megabytes()
        callback.save()
        raised = peak_megabytes() - before
        for _ in range(args.repeats):
            shutil.rmtree(Path(name) / "checkpoints")
            times["numpy.save and fsync"].append(seconds_of(lambda: save_plainly(model, Path(name) / "plain")))
            shutil.rmtree(Path(name) / "plain")
            times["checkpoint"].append(seconds_of(callback.save))
    ratio = statistics.median(one / base for base, one in zip(*times.values(), strict=True))
    print(f"buffer of {args.transitions} transitions: {size:.0f} MiB")
    for what, values in times.items():
        print(f"{what}: {statistics.median(values):.2f} s ({', '.join(f'{value:.2f}' for value in values)})")
    print(f"median ratio: {ratio:.2f}; the peak of memory rose by {raised:.0f} MiB")
    return int(ratio > 2.0 or raised > size / 10)


if __name__ == "__main__":
    sys.exit(main())
