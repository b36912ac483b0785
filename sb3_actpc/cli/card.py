"""``sb3-actpc card``: a model repository for the Hugging Face hub, written offline."""

import argparse
from pathlib import Path

from sb3_actpc.cli import count
from sb3_actpc.envs import UNSEEN_SEED


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    about = "write a Hugging Face model repository of a run, offline; its model.zip is unpickled: open only runs you trust"
    parser = subparsers.add_parser("card", help=about, description=about)
    add = parser.add_argument
    add("folder", type=Path, metavar="RUN", help="folder of a finished run, as written by sb3-actpc train")
    add("--output", type=Path, metavar="DIR", help="folder to write (default: RUN/card)")
    add("--episodes", type=count, default=10, metavar="N", help="evaluation episodes (default: %(default)s)")
    add("--seed", type=int, default=UNSEEN_SEED, help="seed of the first (default: %(default)s)")
    add("--no-video", action="store_true", help="no replay.mp4")


def run(args: argparse.Namespace) -> int:
    """Write it and list the files; a machine that cannot render is no error."""
    from sb3_actpc.experiments.cards import write_card
    from sb3_actpc.experiments.runs.video import choose_gl_backend

    if not args.no_video:
        choose_gl_backend()
    target = args.output or args.folder / "card"
    for note in write_card(args.folder, target, args.episodes, args.seed, video=not args.no_video):
        print(note)
    print(f"written to {target}: {', '.join(sorted(path.name for path in target.iterdir()))}")
    return 0
