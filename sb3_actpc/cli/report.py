"""``sb3-actpc report``: what a comparison has come to."""

import argparse
import sys
from pathlib import Path


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser(
        "report",
        help="tables and figures of a comparison",
        description="Write report.md, report.html, results.csv and figures about the finished runs of a comparison. Trains "
        "nothing; can be given while the comparison goes on.",
    )
    parser.add_argument("folder", metavar="DIR", nargs="?", help="folder of sb3-actpc compare, or of an export")
    kept = "write instead what is worth keeping: results.csv, curves.csv.gz, settings.json and a figure for each task"
    parser.add_argument("--export", metavar="TARGET", help=kept)
    tables = "write the tables between the markers of Markdown files, from the exports that the markers name"
    parser.add_argument("--tables", metavar="FILE", nargs="+", help=tables)


def run(args: argparse.Namespace) -> int:
    """Write the report, the export or the tables; 1 when an ablation has changed not one action, which is an error of the
    agent's."""
    from sb3_actpc.experiments.report.ablations import without_effect
    from sb3_actpc.experiments.report.build import write_report
    from sb3_actpc.experiments.report.export import export
    from sb3_actpc.experiments.report.published import write_tables
    from sb3_actpc.experiments.report.results import load_results

    if args.folder is None and not args.tables:
        raise ValueError("nothing to report on: give the folder of a comparison, or --tables FILE.md")
    if args.export is not None and args.folder is None:
        raise ValueError("nothing to export: give the folder of a comparison")
    files = []
    if args.folder is not None:
        folder = Path(args.folder)
        files += write_report(folder) if args.export is None else export(folder, Path(args.export))
    files += [path for path in map(Path, args.tables or ()) if write_tables(path)]
    for path in files:
        print(path)
    if args.folder is None or args.export is not None:
        return 0
    results = load_results(folder)
    idle = {task: names for task in results.finished["task"].unique() if (names := without_effect(results, task))}
    for task, names in idle.items():
        message = f"{task}: not one action changed in {', '.join(names)}: the part does nothing"
        print(f"sb3-actpc: error: {message}", file=sys.stderr)
    return 1 if idle else 0
