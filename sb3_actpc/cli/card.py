"""``sb3-actpc card``: a model repository for the Hugging Face hub, written offline."""

import argparse
from pathlib import Path


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser(
        "card",
        help="write a Hugging Face model repository of a run",
        description="Write README.md with a model index, the model as zip and safetensors, config, results and a video. "
        "Nothing is uploaded. The run's model.zip is unpickled: open only runs you trust.",
    )
    add = parser.add_argument
    add("folder", type=Path, metavar="RUN", help="folder of a finished run, as written by sb3-actpc train")
    add("--output", type=Path, metavar="DIR", help="folder to write (default: RUN/card)")
    add("--episodes", type=int, default=10, metavar="N", help="evaluation episodes (default: %(default)s)")
    add("--seed", type=int, default=0, help="seed of the first (default: %(default)s)")
    add("--no-video", action="store_true", help="no replay.mp4")


def run(args: argparse.Namespace) -> int:
    """Write it and list the files; a machine that cannot render is no error."""
    from sb3_actpc.experiments.runs.video import choose_gl_backend

    if not args.no_video:
        choose_gl_backend()  # before MuJoCo is imported

    from sb3_actpc.experiments.cards import write_card

    target = args.output or args.folder / "card"
    card = write_card(args.folder, target, args.episodes, args.seed, video=not args.no_video)
    for note in card.notes:
        print(note)
    print(f"written to {card.folder}: {', '.join(card.files)}")
    return 0
