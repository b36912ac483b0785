"""``sb3-actpc bench``: what one update costs, as ratios to SB3's TD3 and to the matrix products alone; by choice also what a
step of training or acting costs, and growth with sizes; with ``--robosuite``, robosuite tasks over robosuite's own loop."""

import argparse
import json
from pathlib import Path
from typing import Any


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser("bench", help="time one update of ActPC against SB3's TD3")
    parser.add_argument("--rounds", type=int, default=40, help="interleaved measurements of every entry")
    parser.add_argument("--threads", type=int, default=None, help="torch threads (default: torch's own choice)")
    parser.add_argument("--device", default="cpu", help="torch device")
    parser.add_argument("--batch-size", type=int, default=256, help="of the updates and the settling alone")
    parser.add_argument("--training", action="store_true", help="also steps of training, and acting (SBX's with sbx-rl)")
    parser.add_argument("--growth", action="store_true", help="also growth with K, width, batch and number of environments")
    parser.add_argument("--output", type=Path, default=None, help="write the ratios to this JSON file")
    parser.add_argument("--table", type=Path, nargs="+", default=None, help="print written ratios as a Markdown table instead")
    parser.add_argument("--robosuite", action="store_true", help="time the robosuite tasks instead")


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    import torch as th

    from sb3_actpc.experiments import timing
    from sb3_actpc.utils.checks import check_device

    if min(args.rounds, args.batch_size) < 1 or (args.threads is not None and args.threads < 1):
        raise ValueError(
            f"--rounds {args.rounds}, --batch-size {args.batch_size} and --threads {args.threads} must be at least 1"
        )
    if args.table:
        print(timing.table(args.table))
        return 0
    check_device(args.device)
    if args.threads is not None:
        th.set_num_threads(args.threads)
    if args.robosuite:
        print(f"medians of {args.rounds} interleaved rounds of {timing.N_ENV_STEPS} steps and a reset")
        for line in timing.robosuite(args.rounds):
            print(line)
        return 0
    groups = [timing.updates(args.device, args.batch_size), timing.settling(args.device, args.batch_size)]
    if args.training:
        groups += [*timing.training(args.device), timing.acting()]
    if args.growth:
        groups += timing.growth()
    ratios = timing.measure(groups, args.rounds, args.device)
    sizes = f"batch {args.batch_size}, hidden [{timing.WIDTH}, {timing.WIDTH}]"
    print(f"{sizes}, {args.device}, {th.get_num_threads()} threads; medians of rounds")
    for name, (ratio, unit) in ratios.items():
        print(f"{name:56s} {ratio:6.2f} x {unit}")
    if args.output:
        device = args.device if args.device == "cpu" else th.cuda.get_device_name(args.device)
        about = {"device": device, "threads": th.get_num_threads(), "batch_size": args.batch_size, "rounds": args.rounds}
        about["torch"] = th.__version__
        args.output.write_text(json.dumps({**about, "ratios": ratios}, indent=1) + "\n")
    print(f"replay memory over SB3's, per HalfCheetah transition: {timing.memory_ratio():.2f}")
    return 0
