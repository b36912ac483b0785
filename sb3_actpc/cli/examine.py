"""``sb3-actpc examine``: whether the critic of a trained agent is worth following."""

import argparse
from pathlib import Path


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser(
        "examine",
        help="ask whether an agent's critic is worth following",
        description="Move the actor's actions along its critic's gradient, against it, at random and towards the "
        "demonstrations, in states of own and demonstrated episodes; play on, and compare the returns with the critic's "
        "differences. Writes RUN/examination.csv. The run's model.zip is unpickled: open only runs you trust.",
    )
    add = parser.add_argument
    add("folder", type=Path, metavar="RUN", help="run folder, as written by sb3-actpc train")
    add("--states", dest="n_states", type=int, default=60, metavar="N", help="states to start from (default: %(default)s)")
    add("--horizon", type=int, default=200, metavar="N", help="steps from each (default: %(default)s)")
    add("--perturbation", type=float, default=0.1, metavar="RMS", help="size of a move (default: %(default)s)")
    add("--hold", type=int, default=1, metavar="N", help="steps with moved actions (default: %(default)s)")
    add("--noise", type=float, default=0.1, metavar="STD", help="of the noisy episodes (default: %(default)s)")
    add("--seed", type=int, default=0, help="of episodes and random moves (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Examine, print the table, write it."""
    from sb3_actpc.experiments.examination import FILE, examine_run

    names = ("n_states", "horizon", "perturbation", "hold", "noise", "seed")
    examination = examine_run(args.folder, **{name: getattr(args, name) for name in names})
    print(f"{examination}\n\nwritten to {args.folder / FILE}")
    return 0
