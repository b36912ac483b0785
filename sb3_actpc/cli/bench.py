"""``sb3-actpc bench``: the time of one update as a ratio to SB3's TD3, and of one step of training as a ratio to RLPD."""

import argparse

from sb3_actpc.cli import count


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser("bench", help="time one update of ActPC against SB3's TD3")
    parser.add_argument("--rounds", type=count, default=40, help="interleaved measurements (default: %(default)s)")
    parser.add_argument("--threads", type=count, help="torch threads (default: torch's own choice)")
    parser.add_argument(
        "--training", action="store_true", help="also steps of training with four updates, to RLPD with sbx-rl"
    )


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    import torch as th

    from sb3_actpc.experiments import timing

    if args.threads is not None:
        th.set_num_threads(args.threads)
    print(f"{timing.TASK}, {th.get_num_threads()} threads, median ratios of times")
    kinds = {f"update, batch {timing.BATCH_SIZE}": timing.updates}
    if args.training:
        kinds[f"step with {timing.N_UPDATES} updates, batch {timing.STEP_BATCH}"] = timing.training
    for kind, entries in kinds.items():
        for name, ratio in timing.measure(entries(), args.rounds).items():
            print(f"{kind:32s}  {name:28s} {ratio:6.2f}")
    return 0
