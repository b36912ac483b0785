"""What a video needs of an environment."""

from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

from sb3_actpc.experiments.runs import video


class ForgetfulEnv(gym.Env[np.ndarray, np.ndarray]):
    """Takes ``render_mode`` and does not keep it."""

    observation_space = spaces.Box(-1.0, 1.0, (1,))
    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, render_mode: str | None = None) -> None: ...


def test_an_environment_that_forgets_its_render_mode_is_said_not_to_render(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(gym.registry, "Forgetful-v0", gym.envs.registration.EnvSpec("Forgetful-v0", ForgetfulEnv))
    model: Any = None
    with pytest.raises(video.RenderingUnavailable, match="render_mode"):
        video.record_video(model, "Forgetful-v0", {}, tmp_path / "x.gif", seed=0)


class Idle:
    """A policy that does nothing."""

    def __init__(self, n_actions: int) -> None:
        self.n_actions = n_actions

    def predict(self, observation: np.ndarray, **_: Any) -> tuple[np.ndarray, None]:
        return np.zeros((len(observation), self.n_actions), np.float32), None

    def get_vec_normalize_env(self) -> None: ...


def robot_share(frame: np.ndarray) -> float:
    """Share of the pixels that are orange, as Gymnasium's robots are; floors and skies are not."""
    return float((frame[..., 0].astype(int) - frame[..., 2] > 40).mean())


class DriftingEnv(MujocoEnv):
    """A ball that moves 10 cm a step, in a model without a camera."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 500}  # type: ignore[misc]

    def __init__(self, folder: str, **options: Any) -> None:
        model = Path(folder) / "ball.xml"
        body = '<body><freejoint/><geom type="sphere" size="1" rgba="1 .5 0 1"/></body>'
        model.write_text(f'<mujoco><worldbody><light pos="0 0 9"/>{body}</worldbody></mujoco>')
        super().__init__(str(model), 1, spaces.Box(-np.inf, np.inf, (7,)), **options)
        self.action_space = spaces.Box(-1.0, 1.0, (1,))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        self.set_state(self.data.qpos + np.eye(7)[0] * 0.1, self.data.qvel)
        return self.data.qpos.copy(), 0.0, False, False, {}

    def reset_model(self) -> np.ndarray:
        return self.data.qpos.copy()


class FarHopper(HopperEnv):
    """Moves 1 m a step; its model has a camera."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        self.set_state(self.data.qpos + np.eye(6)[0], np.zeros(6))
        return np.zeros(11), 0.0, False, False, {}


@pytest.mark.parametrize(("kind", "n_actions"), [(DriftingEnv, 1), (FarHopper, 3)])
def test_the_robot_is_in_view_at_the_last_frame_however_far_it_goes(
    kind: Any, n_actions: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if video.choose_gl_backend() is None:
        pytest.skip("this machine cannot render")
    kwargs = {"folder": str(tmp_path)} if kind is DriftingEnv else {}
    monkeypatch.setitem(gym.registry, "Far-v0", gym.envs.registration.EnvSpec("Far-v0", kind, kwargs=kwargs))
    model: Any = Idle(n_actions)
    given = {"width": 96, "height": 96}
    assert video.record_video(model, "Far-v0", given, tmp_path / "x.gif", seed=0, n_frames=100) == 100
    assert robot_share(imageio.imread(tmp_path / "x.gif")[-1, ..., :3]) > 0.005
