"""``sb3-actpc train`` stopped by signals and by damage, and gone on with by ``--resume``."""

import csv
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
import yaml
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_actpc import ActPC
from sb3_actpc.checkpoints import EXIT_STOPPED, CheckpointCallback, TrainingStopped, continue_learning, list_bundles, restore
from sb3_actpc.cli import main
from tests.actpc.envs import CountingEnv
from tests.checkpoints.runs import Terminate, assert_equal, log_rows, make_actpc

TRAIN = ["train", "--env", "SparseReacher-v5", "--preset", "small.yml", "--demonstrations", "none", "--no-progress"]
TRAIN += ["--eval-freq", "60", "--eval-episodes", "1", "--checkpoint-freq", "40"]


@pytest.fixture
def straight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of the run that is never stopped, of seconds."""
    monkeypatch.chdir(tmp_path)
    settings = {"n_timesteps": 180, "settling": "scheduled", "learning_starts": 20, "batch_size": 16, "buffer_size": 100}
    settings |= {"policy_kwargs": {"net_arch": [16, 16]}, "train_freq": [2, "step"], "gradient_steps": 3}
    settings |= {"learning_rate": "lin_1e-3", "noise_type": "ornstein-uhlenbeck", "noise_std": 0.1}
    Path("small.yml").write_text(yaml.safe_dump({"default": settings}), encoding="utf-8")
    assert main([*TRAIN, "--output", "straight"]) == 0
    return Path("straight")


def test_a_stopped_run_goes_on_as_if_it_never_was(
    straight: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    handlers = [signal.getsignal(one) for one in (signal.SIGTERM, signal.SIGINT)]
    original, sent = ActPC._store_transition, []

    def send(self: ActPC, *arguments: Any) -> Any:
        if self.num_timesteps >= 97 and not sent:
            sent.append(True)
            os.kill(os.getpid(), signal.SIGINT)
        return original(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(ActPC, "_store_transition", send)
        assert main([*TRAIN, "--output", "stopped"]) == EXIT_STOPPED
    assert "saved in stopped/checkpoints/" in (message := capsys.readouterr().err)
    assert "sb3-actpc train --resume stopped" in message
    assert [signal.getsignal(one) for one in (signal.SIGTERM, signal.SIGINT)] == handlers
    assert not Path("stopped/result.json").exists()
    assert main([*TRAIN, "--output", "stopped"]) == 2  # it is not overwritten
    assert main(["train", "--resume", "stopped", "--no-progress"]) == 0
    for name in ("progress.csv", "episodes.csv", "diagnostics.csv"):
        assert log_rows(straight / name) == log_rows(Path("stopped") / name) != []
    one, two = (ActPC.load(folder / "model.zip") for folder in (straight, Path("stopped")))
    assert_equal(one.policy.state_dict(), two.policy.state_dict(), "policy")
    with open("stopped/progress.csv", encoding="utf-8") as file:
        seconds = [float(row["seconds"]) for row in csv.DictReader(file)]
    assert seconds == sorted(seconds)
    assert len(list_bundles("stopped/checkpoints")) == 1  # of the end
    assert main(["train", "--resume", "stopped"]) == 2
    assert "is finished: give it more steps with --steps N" in capsys.readouterr().err


def test_a_second_signal_goes_to_the_old_handler(tmp_path: Path) -> None:
    class Impatient(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 15:
                signal.raise_signal(signal.SIGINT)  # to this thread, at once: two from elsewhere may arrive as one
                signal.raise_signal(signal.SIGINT)
            return True

    callback = CheckpointCallback(tmp_path)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs begin with none
    try:
        with pytest.raises(KeyboardInterrupt):
            make_actpc(CountingEnv).learn(60, [callback, Impatient()])
        callback.close()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_outside_the_main_thread_there_are_checkpoints_but_no_handlers(tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=lambda: make_actpc(CountingEnv).learn(20, CheckpointCallback(tmp_path)))
    thread.start()
    thread.join()
    assert len(list_bundles(tmp_path)) == 1 and signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("algorithm", [ActPC, TD3])
def test_a_script_that_is_stopped_exits_with_the_code(tmp_path: Path, algorithm: Any) -> None:
    """Nobody has to catch anything: TrainingStopped is a SystemExit."""

    def make() -> Any:
        return algorithm("MlpPolicy", make_vec_env(CountingEnv), policy_kwargs={"net_arch": [8]}, buffer_size=99, seed=0)

    with pytest.raises(SystemExit) as stop:
        make().learn(300, [CheckpointCallback(tmp_path), Terminate(150)])
    assert isinstance(stop.value, TrainingStopped) and stop.value.code == EXIT_STOPPED == 75
    again = make()
    assert continue_learning(restore(again, tmp_path), CheckpointCallback(tmp_path)).num_timesteps == 300
    with pytest.raises(ValueError, match="has no CheckpointCallback"):
        continue_learning(restore(again, tmp_path))


def test_a_run_killed_at_random_moments_and_resumed_is_the_run_never_killed() -> None:
    """The short form; ``python benchmarks/kill_and_resume.py`` kills 30 times."""
    script = Path(__file__).resolve().parents[2] / "benchmarks" / "kill_and_resume.py"
    command = [sys.executable, str(script), "--kills", "2", "--steps", "200"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "200 steps: equal" in result.stdout
