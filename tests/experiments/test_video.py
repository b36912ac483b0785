"""What a video needs of an environment."""

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

from sb3_actpc.experiments.runs import video


class Idle:
    """A policy that does nothing with the Hopper's three joints."""

    def predict(self, observation: np.ndarray, **_: Any) -> tuple[np.ndarray, None]:
        return np.zeros((len(observation), 3), np.float32), None

    def get_vec_normalize_env(self) -> None: ...


def robot_share(frame: np.ndarray) -> float:
    """Share of the pixels that are orange, as Gymnasium's robots are; floors and skies are not."""
    return float((frame[..., 0].astype(int) - frame[..., 2] > 40).mean())


def test_a_missing_extra_leaves_a_note_as_a_machine_that_cannot_render_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio.v2", None)
    note = video.video_note(Idle(), "Hopper-v5", {}, tmp_path / "x.gif", 0)
    assert note.startswith("no video: ") and "sb3-actpc[experiments]" in note


class Broken(Idle):
    """A policy with a fault of its own."""

    def predict(self, observation: np.ndarray, **_: Any) -> tuple[np.ndarray, None]:
        raise RuntimeError("my fault")


def test_a_policys_own_error_is_not_taken_for_a_machine_that_cannot_render(tmp_path: Path) -> None:
    if video.choose_gl_backend() is None:
        pytest.skip("this machine cannot render")
    with pytest.raises(RuntimeError, match="my fault"):
        video.video_note(Broken(), "Hopper-v5", {}, tmp_path / "x.gif", 0)


class FarHopper(HopperEnv):
    """Moves 1 m a step; its model has a camera."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        self.set_state(self.data.qpos + np.eye(6)[0], np.zeros(6))
        return np.zeros(11), 0.0, False, False, {}


def test_the_robot_is_in_view_at_the_last_frame_however_far_it_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if video.choose_gl_backend() is None:
        pytest.skip("this machine cannot render")
    monkeypatch.setitem(gym.registry, "Far-v0", gym.envs.registration.EnvSpec("Far-v0", FarHopper))
    model: Any = Idle()
    given = {"width": 96, "height": 96}
    assert video.record_video(model, "Far-v0", given, tmp_path / "x.gif", seed=0, n_frames=100) == 100
    assert robot_share(imageio.imread(tmp_path / "x.gif")[-1, ..., :3]) > 0.005
