"""``sb3-actpc baselines``: what the baselines of other packages need."""

import argparse


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser("baselines", help="install what the baselines of other packages need")
    commands = parser.add_subparsers(dest="baselines_command", required=True, metavar="{install}")
    install = commands.add_parser(
        "install",
        help="make the virtual environment of a package",
        description="Make a virtual environment for d3rlpy (bcq, cql), which pins other versions. The environment variable "
        "SB3_ACTPC_BASELINES says where (default: ~/.cache/sb3_actpc/baselines).",
    )
    install.add_argument("package", choices=["d3rlpy"])


def run(args: argparse.Namespace) -> int:
    """Install."""
    from sb3_actpc.baselines.served import install

    install()
    return 0
