"""A video of one episode, where the machine can render."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sb3_actpc.experiments.runs.evaluation import play_episodes
from sb3_actpc.utils.extras import import_extra

GL_BACKENDS = ("egl", "osmesa")
VIDEO_SUFFIXES = (".mp4", ".gif")
# of one episode; software rendering takes a twentieth of a second for each
MAX_FRAMES = 300
# with one of these the user has chosen the view
CAMERA_KEYWORDS = {"camera_id", "camera_name", "default_camera_config"}
# in a process of its own: a broken graphics driver may end the process
_PROBE = "import mujoco; context = mujoco.GLContext(64, 64); context.make_current(); context.free()"


class RenderingUnavailable(RuntimeError):
    """This machine, or this environment, cannot render; the message says why."""


def choose_gl_backend() -> str | None:
    """Find a way for MuJoCo to render without a window and select it for this process (environment variables); None when
    nothing works. Call it before an environment is made, with which some read the variables: what ``MUJOCO_GL`` names is tried
    first, and unset when nothing works."""
    chosen = os.environ.get("MUJOCO_GL", "")
    for backend in dict.fromkeys(filter(None, (chosen, *GL_BACKENDS))):
        variables = {"MUJOCO_GL": backend}
        if backend in GL_BACKENDS:
            variables["PYOPENGL_PLATFORM"] = backend
        with contextlib.suppress(subprocess.SubprocessError):
            command = [sys.executable, "-c", _PROBE]
            subprocess.run(command, env={**os.environ, **variables}, capture_output=True, timeout=60, check=True)
            os.environ.update(variables)
            return backend
    os.environ.pop("MUJOCO_GL", None)
    return None


def check_video_path(path: Path) -> None:
    """ValueError when a video cannot have this name: the suffix must be one of ``VIDEO_SUFFIXES``."""
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise ValueError(f"the video must end in .mp4 or .gif, found {str(path)!r}")


def video_note(*arguments: Any) -> str:
    """What became of :func:`record_video`, in one line: a machine that cannot render, or lacks the extra, is no error."""
    try:
        return f"video of {record_video(*arguments)} frames written to {arguments[3]}"
    except RenderingUnavailable as error:
        return f"no video: rendering is not available here ({' '.join(str(error).split())})"
    except ImportError as error:
        return f"no video: {error}"


def record_video(
    model: Any, env_id: str, env_kwargs: dict[str, Any], path: Path, seed: int, n_frames: int = MAX_FRAMES
) -> int:
    """Write a video of the first steps, at most ``n_frames``, of an episode with the deterministic policy: the number of
    frames, each (height, width, 3) uint8. ``env_kwargs`` are the environment's, ``width`` and ``height`` in pixels where it
    takes them. RenderingUnavailable when rendering does not work here, ValueError when the path is not one of a video."""
    check_video_path(path)
    imageio = import_extra("imageio.v2", "experiments")
    if path.suffix.lower() == ".mp4":
        import_extra("imageio_ffmpeg", "experiments")
    with _rendering(env_id, env_kwargs) as env:
        frames = _play(model, env, seed, n_frames)
        frames_per_second = float(env.metadata.get("render_fps", 30))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}{path.suffix}")  # the suffix tells imageio the format
    if path.suffix.lower() == ".gif":
        # viewers slow down a GIF with delays below 20 ms
        stride = max(1, round(frames_per_second / 25))
        imageio.mimsave(temporary, frames[::stride], duration=1000 * stride / frames_per_second, loop=0)
    else:
        imageio.mimsave(temporary, frames, fps=frames_per_second, macro_block_size=2)
    temporary.replace(path)
    return len(frames)


@contextlib.contextmanager
def _rendering(env_id: str, env_kwargs: dict[str, Any]) -> Iterator[Any]:
    """The environment, made to render, and closed in the end; ``RenderingUnavailable`` when it renders no first image."""
    import gymnasium as gym
    from mujoco import FatalError

    from sb3_actpc.experiments.runs.environments import make_env

    with contextlib.ExitStack() as opened:
        try:
            env = opened.enter_context(contextlib.closing(make_env(env_id, env_kwargs, render_mode="rgb_array")))
            if env.render_mode is None:
                raise ValueError(f"{env_id} takes render_mode and does not keep it")
            if not CAMERA_KEYWORDS & env_kwargs.keys():
                _follow_robot(env.unwrapped)
            env.reset()
            frame = env.render()
        except (ValueError, FatalError, gym.error.Error, ImportError, OSError, RuntimeError, AttributeError) as error:
            raise RenderingUnavailable(f"{type(error).__name__}: {error}") from error
        if not isinstance(frame, np.ndarray):
            raise RenderingUnavailable(f"the environment renders {type(frame).__name__}, not an image")
        yield env


def _follow_robot(simulator: Any) -> None:
    """Let the camera of a Gymnasium MuJoCo task move with the robot; Gymnasium's own default camera stays at the start."""
    import mujoco

    renderer = getattr(simulator, "mujoco_renderer", None)
    if renderer is None:
        return
    tracking = mujoco.mj_name2id(simulator.model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
    if tracking >= 0:
        renderer.camera_id = tracking
    elif renderer.default_cam_config is None:  # the task chooses no view
        renderer.camera_id = None
        renderer.default_cam_config = {"type": mujoco.mjtCamera.mjCAMERA_TRACKING, "trackbodyid": 1}


def _play(model: Any, env: Any, seed: int, n_frames: int) -> list[np.ndarray]:
    from gymnasium.wrappers import RenderCollection, TimeLimit

    collection = RenderCollection(TimeLimit(env, max(1, n_frames - 1)))
    play_episodes(model, [collection], 1, seed)
    frames: list[np.ndarray] = collection.render()  # type: ignore[assignment]
    return frames[:n_frames]
