"""``sb3-actpc compare``: many runs, brought to their end however often they are stopped."""

import argparse
import sys
from functools import partial
from pathlib import Path

from sb3_actpc.cli import add_run_options, count, given


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    about = "train several algorithms on several tasks with several seeds; stopped or killed, the same command goes on"
    parser = subparsers.add_parser("compare", help=about, description=about)
    add = parser.add_argument
    file = "YAML file with these options as keys; options replace its values, but not those of a task's or variant's own entry"
    add("file", nargs="?", metavar="FILE", help=file)
    add("--envs", nargs="+", metavar="ID", help="tasks, such as SparseHopper-v5")
    add("--algos", nargs="+", metavar="NAME", help="algorithms, named variants (also FILE's own), or MODULE:CLASS: actpc td3")
    add("--seeds", type=int, metavar="N", help="how many seeds (default: 3)")
    add("--first-seed", type=int, metavar="N", help="the first of them (default: 0)")
    add("--output", metavar="DIR", help="folder of the comparison (default: runs/comparison)")
    add_run_options(parser)
    add(
        "--workers",
        type=count,
        metavar="N",
        help="runs at a time on this machine (default: as many as the cores allow with --threads each)",
    )
    add("--engine", default="local", choices=["local", "ray"], help="processes, or a Ray cluster (default: local)")
    add("--address", help="Ray cluster to use (default: one is started on this machine)")
    add("--retry-failed", action="store_true", help="try runs again that failed before")
    add("--dry-run", action="store_true", help="print the table of runs, and end")


def run(args: argparse.Namespace) -> int:
    """Bring the runs to their end; 1 when runs have failed, 75 when a signal stopped the command."""
    from sb3_actpc.checkpoints import EXIT_STOPPED
    from sb3_actpc.experiments.comparison import plan_runs, read_comparison, schedule
    from sb3_actpc.experiments.comparison.plan import OWN_KEYS, read_comparison_file, with_options
    from sb3_actpc.experiments.runs import Run
    from sb3_actpc.experiments.runs.presets import missing_demonstrations
    from sb3_actpc.utils.extras import import_extra

    if args.engine == "local" and args.address is not None:
        raise ValueError(f"--address {args.address} is of a Ray cluster: give --engine ray, or leave it out")
    from_file = {} if args.file is None else read_comparison_file(Path(args.file))
    comparison = read_comparison(with_options(from_file, given(args, (*OWN_KEYS, *Run.known_keys()))))
    runs = plan_runs(comparison)
    folder = Path(comparison.output)
    for missing in dict.fromkeys(filter(None, map(missing_demonstrations, runs))):
        print(missing)
    if args.dry_run:
        rows = [[run.id, run.task, run.name, run.seed, run.n_timesteps, schedule.run_status(run.folder)] for run in runs]
        columns = ["id", "task", "variant", "seed", "steps", "state"]
        print(import_extra("pandas", "experiments").DataFrame(rows, columns=columns).to_string(index=False))
        return 0
    threads = max(run.threads for run in runs)
    engine: schedule.Engine = partial(schedule.run_in_processes, args.workers, threads)
    if args.engine == "ray":
        engine = partial(schedule.run_on_ray, args.address, threads)
    stopped_by = schedule.run_comparison(runs, folder, engine, args.retry_failed, not args.no_progress)
    unfinished = [run for run in runs if schedule.run_status(run.folder) != schedule.FINISHED]
    print(f"{len(runs) - len(unfinished)} of {len(runs)} runs are finished; see them with: sb3-actpc report {folder}")
    for run in unfinished:
        error = schedule.read_error(run.folder)
        if error:
            print(f"sb3-actpc: failed (--retry-failed tries again): {run.label} ({run.folder}): {error}", file=sys.stderr)
    if stopped_by is not None:
        left = f"{len(unfinished)} runs are left, the same command goes on with them"
        print(f"sb3-actpc: stopped by {stopped_by}; {left}", file=sys.stderr)
        return EXIT_STOPPED
    return int(bool(unfinished))
