"""Every test of the commands works in an empty folder, with the line as a task and TD3 as SB3 has it."""

from pathlib import Path

import gymnasium as gym
import pytest
import yaml

from sb3_actpc.experiments.runs import ALGORITHMS
from tests.cli.line import ENV_ID


@pytest.fixture(autouse=True)
def line_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Register the environment and TD3, and work in an empty folder with a preset for it."""
    if ENV_ID not in gym.registry:
        gym.register(ENV_ID, entry_point="tests.cli.line:LineEnv")
    monkeypatch.setitem(ALGORITHMS, "td3", "stable_baselines3:TD3")
    monkeypatch.chdir(tmp_path)
    settings = {"n_timesteps": 60, "learning_starts": 20, "policy_kwargs": {"net_arch": [8]}}
    Path("small.yml").write_text(yaml.safe_dump({"default": settings}), encoding="utf-8")
