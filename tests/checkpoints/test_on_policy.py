"""PPO and TRPO, stopped and gone on with, are those that never stopped: statistics of the observations, returns and all."""

from pathlib import Path
from typing import Any

import pytest

from sb3_actpc.baselines import LOGO
from sb3_actpc.checkpoints import CheckpointCallback, TrainingStopped, list_bundles
from sb3_actpc.experiments.runs import Run, finish_run
from tests.checkpoints.runs import Terminate, log_rows

SETTINGS: dict[str, dict[str, Any]] = {
    "ppo": {"n_steps": 32, "batch_size": 16, "n_epochs": 2, "use_sde": True},
    "trpo": {"n_steps": 32, "batch_size": 16, "n_critic_updates": 2},
}


def run_of(algo: str, folder: Path) -> Run:
    return Run(
        env="Pendulum-v1", algo=algo, settings={**SETTINGS[algo], "policy_kwargs": {"net_arch": [8]}}, n_timesteps=512,
        normalize=True, n_envs=2, eval_freq=64, eval_episodes=1, demonstrations="none", progress=False, output=str(folder),
    )  # fmt: skip


@pytest.mark.parametrize("algo", ["ppo", "trpo"])
def test_a_stopped_run_goes_on_as_if_it_never_was(algo: str, tmp_path: Path) -> None:
    finish_run(run_of(algo, tmp_path / "straight"))
    with pytest.raises(TrainingStopped):
        finish_run(run_of(algo, tmp_path / "stopped"), callbacks=[Terminate(300)])
    assert len(list_bundles(tmp_path / "stopped" / "checkpoints")) >= 1
    lines: list[str] = []
    finish_run(run_of(algo, tmp_path / "stopped"), lines.append)
    assert "512 steps from step 320" in lines[0]  # the rollout of 64 steps that the signal fell in is finished first
    for name in ("progress.csv", "episodes.csv"):
        rows = log_rows(tmp_path / "straight" / name)
        assert rows and log_rows(tmp_path / "stopped" / name) == rows


def test_an_algorithm_with_a_state_of_its_own_is_refused(tmp_path: Path) -> None:
    model = LOGO("MlpPolicy", "Pendulum-v1", n_steps=16, batch_size=16)
    with pytest.raises(ValueError, match="LOGO keeps no checkpoints"):
        model.learn(16, CheckpointCallback(tmp_path))
