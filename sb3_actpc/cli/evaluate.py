"""``sb3-actpc evaluate``: replay a trained agent, with a video where the machine can render."""

import argparse
from pathlib import Path


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser(
        "evaluate",
        help="replay the agent of a run",
        description="Play episodes with the agent of a run folder. Its model.zip is unpickled: open only runs you trust.",
    )
    add = parser.add_argument
    add("folder", type=Path, metavar="RUN", help="run folder, as written by sb3-actpc train")
    add("--episodes", type=int, default=10, metavar="N", help="episodes to play (default: %(default)s)")
    add("--seed", type=int, default=0, help="seed of the first episode (default: %(default)s)")
    add("--video", metavar="FILE", help="video of the first episode, .mp4 or .gif, or a .png strip (default: RUN/video.mp4)")
    add("--frames", type=int, default=300, metavar="N", help="its most frames (default: %(default)s)")
    add("--size", type=int, metavar="PIXELS", help="its height and width (default: the environment's)")
    add("--beside-demonstrator", action="store_true", help="draw the run's first demonstrated episode on the agent's right")
    add("--no-video", action="store_true", help="no video")


def run(args: argparse.Namespace) -> int:
    """Play, print the table, record; a machine that cannot render is no error."""
    from sb3_actpc.experiments.runs.video import RenderingUnavailable, check_video_path, choose_gl_backend, record_video

    folder = args.folder
    video = None if args.no_video else Path(args.video or folder / "video.mp4")
    if video is not None:
        for option, value in (("--frames", args.frames), ("--size", args.size)):
            if value is not None and value < 1:
                raise ValueError(f"{option} must be at least 1, found {value}")
        check_video_path(video)
        choose_gl_backend()  # before MuJoCo is imported

    from sb3_actpc.demonstrations import resolve
    from sb3_actpc.experiments.runs import evaluate_run, load_run
    from sb3_actpc.experiments.runs.presets import find_demonstrations
    from sb3_actpc.experiments.runs.record import is_finished
    from sb3_actpc.experiments.runs.summary import result_table

    print(result_table(evaluate_run(folder, args.episodes, args.seed)), flush=True)
    if not is_finished(folder):
        print(f"{folder} is not finished: this was the agent of its last evaluation (sb3-actpc train --resume {folder})")
    if video is None:
        return 0
    run, model = load_run(folder)
    size = {} if args.size is None else {"width": args.size, "height": args.size}
    env_kwargs, demonstrations = {**run.env_kwargs, **size}, None
    if args.beside_demonstrator:
        source = find_demonstrations(run.env, run.demonstrations)
        if source is None:
            raise ValueError(f"{folder} was trained without demonstrations: leave --beside-demonstrator out")
        demonstrations = resolve(source)
    try:
        n_frames = record_video(model, run.env, env_kwargs, video, args.seed, args.frames, demonstrations)
    except RenderingUnavailable as error:
        print(f"no video: rendering is not available here ({' '.join(str(error).split())})")
    else:
        print(f"video of {n_frames} frames written to {video}")
    return 0
