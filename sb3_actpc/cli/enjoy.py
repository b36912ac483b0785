"""``sb3-actpc enjoy``: play an agent that comes with the package, in a window or as a video."""

import argparse
import os
import sys
from pathlib import Path


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser(
        "enjoy",
        help="play a trained agent that comes with the package",
        description="Play a bundled agent in a window. Where there is no display, write a video that keeps the robot in view.",
    )
    add = parser.add_argument
    add("--env", required=True, help="Gymnasium id, such as SparseReacher-v5")
    add("--episodes", type=int, default=3, metavar="N", help="episodes to play (default: %(default)s)")
    add("--seed", type=int, default=0, help="seed of the first episode (default: %(default)s)")
    add("--video", type=Path, metavar="FILE", help="video of the first episode, .mp4, .gif or .png, instead of a window")
    add("--frames", type=int, default=300, metavar="N", help="its most frames (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Play; a machine that cannot render is no error."""
    from sb3_actpc.experiments.runs.video import RenderingUnavailable, check_video_path, choose_gl_backend, record_video

    for option, value in (("--episodes", args.episodes), ("--frames", args.frames)):
        if value < 1:
            raise ValueError(f"{option} must be at least 1, found {value}")
    video = args.video
    if video is None and not _has_display():
        video = Path(f"{args.env.replace(':', '_')}.mp4")
    if video is not None:
        check_video_path(video)
        choose_gl_backend()  # before MuJoCo is imported

    from sb3_actpc.experiments.runs.environments import make_env
    from sb3_actpc.experiments.runs.evaluation import play_episodes
    from sb3_actpc.pretrained import find_agent, load_pretrained

    row = find_agent(args.env)
    model = load_pretrained(args.env)
    print(f"{args.env}: {row['timesteps']} steps, seed {row['seed']}, return {row['return']:.1f} ± {row['return_std']:.1f}")
    mode = "human" if video is None else None
    with make_env(args.env, row["env_kwargs"], render_mode=mode) as env:
        played = play_episodes(model, [env], args.episodes, args.seed)
    for number, value in enumerate(played.returns):
        print(f"episode {number}: return {value:.1f}, {int(played.lengths[number])} steps")
    if video is None:
        return 0
    try:
        n_frames = record_video(model, args.env, row["env_kwargs"], video, args.seed, args.frames)
    except RenderingUnavailable as error:
        print(f"no video: rendering is not available here ({' '.join(str(error).split())})")
    else:
        print(f"video of {n_frames} frames written to {video}")
    return 0


def _has_display() -> bool:
    """Whether a window can be opened: always supposed on Windows and macOS."""
    return sys.platform in ("win32", "darwin") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
