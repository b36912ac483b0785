"""``sb3-actpc evaluate``: replay a trained agent, with a video where the machine can render."""

import argparse
from pathlib import Path

from sb3_actpc.cli import count
from sb3_actpc.envs import UNSEEN_SEED


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    about = "replay the agent of a run; its model.zip is unpickled: open only runs you trust"
    parser = subparsers.add_parser("evaluate", help=about, description=about)
    add = parser.add_argument
    add("folder", type=Path, metavar="RUN", help="run folder, as written by sb3-actpc train")
    add("--episodes", type=count, default=10, metavar="N", help="episodes to play (default: %(default)s)")
    about = "seed of the first episode (default: %(default)s, whose start states neither the run nor demonstrations had)"
    add("--seed", type=int, default=UNSEEN_SEED, help=about)
    add("--video", metavar="FILE", help="video of the first episode, .mp4 or .gif (default: RUN/video.mp4)")
    add("--no-video", action="store_true", help="no video")


def run(args: argparse.Namespace) -> int:
    """Play, print the table, record; a machine that cannot render is no error."""
    from sb3_actpc.experiments.runs import evaluate_run, load_run
    from sb3_actpc.experiments.runs.record import is_finished
    from sb3_actpc.experiments.runs.run import result_table
    from sb3_actpc.experiments.runs.video import check_video_path, choose_gl_backend, video_note

    folder = args.folder
    video = Path(args.video or folder / "video.mp4")
    if not args.no_video:
        check_video_path(video)
        choose_gl_backend()
    print(result_table(evaluate_run(folder, args.episodes, args.seed)), flush=True)
    if not is_finished(folder):
        print(f"{folder} is not finished: this was the agent of its last evaluation (sb3-actpc train --resume {folder})")
    if not args.no_video:
        run, model = load_run(folder)
        print(video_note(model, run.env, run.env_kwargs, video, args.seed))
    return 0
