"""``sb3-actpc baselines``: what the baselines of other packages need."""

import argparse
from pathlib import Path


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser("baselines", help="install what the baselines of other packages need")
    commands = parser.add_subparsers(dest="baselines_command", required=True, metavar="{install}")
    install = commands.add_parser(
        "install",
        help="make the virtual environment of a package",
        description="Make a virtual environment for a package that pins other versions: d3rlpy (bcq, cql). "
        "One that is whole stays as it is. The environment variable SB3_ACTPC_BASELINES says where they are "
        "(default: ~/.cache/sb3_actpc/baselines).",
    )
    install.add_argument("package", help="d3rlpy")
    install.add_argument("--dir", metavar="DIR", help="folder of the environments (default: as above)")


def run(args: argparse.Namespace) -> int:
    """Install."""
    from sb3_actpc.baselines.offline.installation import FOLDER_VARIABLE, environments_folder, install

    folder = None if args.dir is None else Path(args.dir).absolute()
    install(args.package, folder, report=lambda line: print(line, flush=True))
    if folder is not None and folder != environments_folder():
        print(f"to use it: export {FOLDER_VARIABLE}={folder}")
    return 0
