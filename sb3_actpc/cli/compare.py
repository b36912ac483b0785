"""``sb3-actpc compare``: many runs, brought to their end however often they are stopped."""

import argparse
import sys
from functools import partial
from pathlib import Path

from sb3_actpc.cli import add_run_options, given


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser(
        "compare",
        help="train several algorithms on several tasks with several seeds",
        description="Train every algorithm on every task with every seed. Stopped at any moment, even killed, the same "
        "command goes on: finished runs are not repeated, the others continue from their last checkpoint. "
        "`sb3-actpc report` shows what has come of it.",
    )
    add = parser.add_argument
    file = "YAML file with these options as keys; options replace its values, but not those of a task's or variant's own entry"
    add("file", nargs="?", metavar="FILE", help=file)
    add("--envs", nargs="+", metavar="ID", help="tasks, such as SparseHopper-v5")
    add(
        "--algos",
        nargs="+",
        metavar="NAME",
        help="algorithms, named variants, also FILE's own, or MODULE:CLASS, such as actpc td3",
    )
    add("--seeds", type=int, metavar="N", help="how many seeds (default: 3)")
    add("--first-seed", type=int, metavar="N", help="the first of them (default: 0)")
    add("--output", metavar="DIR", help="folder of the comparison (default: runs/comparison)")
    add_run_options(parser)
    add("--workers", type=int, metavar="N", help="runs at a time (default: one for each core)")
    add("--engine", default="local", metavar="{local,ray}", help="processes, or a Ray cluster (default: local)")
    add("--address", help="Ray cluster to use (default: one is started on this machine)")
    add("--retry-failed", action="store_true", help="try runs again that failed before")
    add("--dry-run", action="store_true", help="print the table of runs, with the seconds of those finished, and end")


def run(args: argparse.Namespace) -> int:
    """Bring the runs to their end; 1 when runs have failed, 75 when a signal or a full disk stopped the command."""
    from sb3_actpc.checkpoints import EXIT_STOPPED
    from sb3_actpc.experiments.comparison import make_engine, plan_runs, read_comparison
    from sb3_actpc.experiments.comparison.display import Display, describe_runs
    from sb3_actpc.experiments.comparison.plan import OWN_KEYS, read_comparison_file, with_options
    from sb3_actpc.experiments.comparison.schedule import run_comparison
    from sb3_actpc.experiments.runs import Run
    from sb3_actpc.experiments.runs.presets import missing_demonstrations

    from_file = {} if args.file is None else read_comparison_file(Path(args.file))
    comparison = read_comparison(with_options(from_file, given(args, (*OWN_KEYS, *Run.known_keys()))))
    runs, folder = plan_runs(comparison), Path(comparison.output)
    for missing in dict.fromkeys(filter(None, map(missing_demonstrations, runs))):
        print(missing)
    if args.dry_run:
        print(describe_runs(runs))
        return 0
    engine = partial(make_engine, args.engine, args.workers, max(run.threads for run in runs), args.address)
    with Display(not args.no_progress) as display:
        summary = run_comparison(runs, folder, engine, display, args.retry_failed)
    print(f"{len(summary.finished)} of {len(runs)} runs are finished; see them with: sb3-actpc report {folder}")
    for run, message in summary.failed:
        print(f"sb3-actpc: failed: {run.label} ({run.folder}): {message}", file=sys.stderr)
    if summary.stopped_by is not None:
        reason = f"the disk is full ({summary.message}), free some space" if summary.message else summary.stopped_by
        left = f"{len(summary.unfinished)} runs are left, the same command goes on with them"
        print(f"sb3-actpc: stopped by {reason}; {left}", file=sys.stderr)
        return EXIT_STOPPED
    if summary.failed:
        print("sb3-actpc: try failed runs again with --retry-failed", file=sys.stderr)
        return 1
    return 0
