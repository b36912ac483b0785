"""``sb3-actpc enjoy``: play an agent that comes with the package, in a window or as a video."""

import argparse
import os
import sys
from pathlib import Path

from sb3_actpc.cli import count
from sb3_actpc.envs import UNSEEN_SEED


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    about = "play an agent that comes with the package, in a window or, where there is no display, as a video"
    parser = subparsers.add_parser("enjoy", help=about, description=about)
    add = parser.add_argument
    add("--env", required=True, help="Gymnasium id, such as SparseReacher-v5")
    add("--episodes", type=count, default=3, metavar="N", help="episodes to play (default: %(default)s)")
    add("--seed", type=int, default=UNSEEN_SEED, help="seed of the first episode (default: %(default)s)")
    add("--video", type=Path, metavar="FILE", help="video of the first episode, .mp4 or .gif, instead of a window")


def run(args: argparse.Namespace) -> int:
    """Play; a machine that cannot render is no error."""
    from sb3_actpc.experiments.runs.environments import make_env
    from sb3_actpc.experiments.runs.evaluation import play_episodes
    from sb3_actpc.experiments.runs.video import check_video_path, choose_gl_backend, video_note
    from sb3_actpc.pretrained import find_agent, load_pretrained

    video = args.video
    has_display = sys.platform in ("win32", "darwin") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    if video is None and not has_display:
        video = Path(f"{args.env.replace(':', '_')}.mp4")
    if video is not None:
        check_video_path(video)
        choose_gl_backend()
    row = find_agent(args.env)
    model = load_pretrained(args.env)
    print(f"{args.env}: {row['timesteps']} steps, seed {row['seed']}, return {row['return']:.1f} ± {row['return_std']:.1f}")
    mode = "human" if video is None else None
    with make_env(args.env, row["env_kwargs"], render_mode=mode) as env:
        played = play_episodes(model, [env], args.episodes, args.seed)
    for number, value in enumerate(played.returns):
        print(f"episode {number}: return {value:.1f}, {int(played.lengths[number])} steps")
    if video is not None:
        print(video_note(model, args.env, row["env_kwargs"], video, args.seed))
    return 0
