"""Memory of a training process after its replay buffer is full.

    python benchmarks/memory_growth.py --steps 100000

Prints the resident memory when the buffer has been full for a while and after so many further steps; exit code 1 when it grew
by 1% or more.
"""

import argparse
import gc
import sys
import tempfile
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

import sb3_actpc.envs  # noqa: F401, registers the task
from sb3_actpc import ActPC
from sb3_actpc.checkpoints import CheckpointCallback


def resident_megabytes() -> float:
    """Resident memory of this process (Linux)."""
    gc.collect()
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("/proc/self/status has no VmRSS")


class Watch(BaseCallback):
    """Notes the memory at the first call after ``since`` steps and prints it ten times after that."""

    def __init__(self, since: int, n_steps: int) -> None:
        super().__init__()
        self.since, self.n_steps, self.first, self.last = since, n_steps, 0.0, 0.0

    def _on_step(self) -> bool:
        if self.num_timesteps == self.since:
            self.first = resident_megabytes()
            print(f"step {self.num_timesteps}: {self.first:.1f} MiB", flush=True)
        elif self.num_timesteps > self.since and (self.num_timesteps - self.since) % max(1, self.n_steps // 10) == 0:
            self.last = resident_megabytes()
            print(f"step {self.num_timesteps}: {self.last:.1f} MiB", flush=True)
        return True


def main() -> int:
    """:return: exit code"""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--buffer-size", type=int, default=5_000)
    parser.add_argument("--train-freq", type=int, default=2, help="steps between two updates")
    args = parser.parse_args()
    since = 2 * args.buffer_size
    model = ActPC(
        "MlpPolicy", make_vec_env("SparseReacher-v5"), settling="scheduled", buffer_size=args.buffer_size, batch_size=16,
        replay_buffer_kwargs={"self_imitation_size": args.buffer_size}, policy_kwargs={"net_arch": [16, 16]},
        train_freq=args.train_freq, seed=0,
    )  # fmt: skip
    watch = Watch(since, args.steps)
    with tempfile.TemporaryDirectory() as folder:
        model.learn(since + args.steps, [watch, CheckpointCallback(folder, max(1, args.steps // 20), at_end=False)])
    growth = watch.last / watch.first - 1.0
    print(f"grew by {growth:.2%} over {args.steps} steps")
    return int(growth >= 0.01)


if __name__ == "__main__":
    sys.exit(main())
