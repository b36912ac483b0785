"""What a video needs of an environment."""

import dataclasses
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv

from sb3_actpc.demonstrations import Demonstrations, shipped_demonstrations
from sb3_actpc.envs import SPARSE_MUJOCO_IDS
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
    with pytest.raises(video.RenderingUnavailable, match="Forgetful-v0 takes render_mode and does not keep it"):
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


@pytest.fixture
def renders() -> None:
    if video.choose_gl_backend() is None:
        pytest.skip("this machine cannot render")


@pytest.mark.usefixtures("renders")
@pytest.mark.parametrize("env_id", [env_id for env_id in SPARSE_MUJOCO_IDS if "Reacher" not in env_id and "v5" in env_id])
def test_the_robot_is_in_view_at_the_last_frame_however_far_it_goes(env_id: str, tmp_path: Path) -> None:
    shown = Demonstrations.load(shipped_demonstrations(env_id)).select(n_transitions=12)
    assert shown.dense_rewards is not None
    fast = dataclasses.replace(shown, dense_rewards=shown.dense_rewards + 500.0)
    size = {"width": 96, "height": 96}
    with gym.make(env_id) as env:
        task: Any = env.unwrapped
        assert task.demonstrated_positions(fast)[-1, 0] > 20.0, "metres"
    model: Any = Idle(shown.actions.shape[1])
    video.record_video(model, env_id, size, tmp_path / "x.gif", seed=0, n_frames=12, demonstrations=fast)
    last = imageio.imread(tmp_path / "x.gif")[-1, ..., :3]
    agent, demonstrator = np.split(last, 2, axis=1)
    assert robot_share(agent) > 0.005 and robot_share(demonstrator) > 0.005
    own = {**size, "camera_id": -1}  # the user's choice of a camera is kept
    video.record_video(model, env_id, own, tmp_path / "own.gif", seed=0, n_frames=12, demonstrations=fast)
    last = imageio.imread(tmp_path / "own.gif")[-1, ..., :3]
    assert robot_share(np.split(last, 2, axis=1)[1]) < 0.005


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


@pytest.mark.usefixtures("renders")
def test_a_robot_without_a_camera_of_its_own_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry_point: Any = DriftingEnv
    spec = gym.envs.registration.EnvSpec("Drifting-v0", entry_point, kwargs={"folder": str(tmp_path)})
    monkeypatch.setitem(gym.registry, "Drifting-v0", spec)
    model: Any = Idle(1)
    video.record_video(model, "Drifting-v0", {"width": 96, "height": 96}, tmp_path / "x.gif", seed=0, n_frames=100)
    assert robot_share(imageio.imread(tmp_path / "x.gif")[-1, ..., :3]) > 0.01


@pytest.mark.usefixtures("renders")
def test_the_reachers_arm_is_in_view(tmp_path: Path) -> None:
    """Frames with and without it differ."""
    model: Any = Idle(2)
    video.record_video(model, "SparseReacher-v5", {"width": 96, "height": 96}, tmp_path / "x.gif", seed=0, n_frames=2)
    with gym.make("SparseReacher-v5", render_mode="rgb_array", width=96, height=96) as env:
        env.reset(seed=0)
        simulator: Any = env.unwrapped
        simulator.model.geom_rgba[[simulator.model.geom(name).id for name in ("link0", "link1", "fingertip")], 3] = 0.0
        without: Any = env.render()
    first = imageio.imread(tmp_path / "x.gif")[0, ..., :3]
    assert np.mean(np.any(np.abs(first.astype(int) - without) > 40, axis=2)) > 0.003
