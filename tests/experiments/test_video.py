"""What a video needs of an environment."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

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
