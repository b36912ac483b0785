"""Methods of another package, in processes of their own: what comes out of them, and what comes of failures."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_actpc.baselines import BCQ, CQL
from sb3_actpc.baselines.served import SERVER, ServedAlgorithm, environment_python
from sb3_actpc.cli import main
from sb3_actpc.experiments.runs import load_preset, play_episodes
from tests.recordings import record

# Its action is the number of its gradient steps in hundredths.
FAKE_SERVER = """
import os, sys, time
sys.path.insert(0, {folder!r})
import numpy as np
from d3rlpy_server import serve

class Fake:
    def build(self, method, n_observations, n_actions, batch_size, seed, kwargs, trained):
        self.n, self.kwargs = sum(trained), kwargs
        print("libraries print what they like", flush=True)
        if "refuse" in kwargs:
            raise ValueError("net_arch must be a list")

    def train(self, batch):
        assert len(batch["rewards"]) == 100 and abs(batch["actions"]).max() <= 1 and abs(batch["observations"]).mean() < 2
        self.n += 1
        if self.n == self.kwargs.get("die_at"):
            os._exit(3)
        return {{"loss": 1.0 / self.n}}

    def predict(self, observations):
        return np.full((len(observations), 1), 0.01 * self.n, dtype=np.float32)

    def save(self):
        return bytes([self.n])

serve(Fake())
"""


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """CQL is served by this script."""
    script = tmp_path / "fake_server.py"
    script.write_text(FAKE_SERVER.format(folder=str(SERVER.parent)), encoding="utf-8")
    monkeypatch.setattr("sb3_actpc.baselines.served.SERVER", script)
    monkeypatch.setattr("sb3_actpc.baselines.served.environment_python", lambda: sys.executable)
    return script


def make(**options: Any) -> CQL:
    return CQL("MlpPolicy", "Pendulum-v1", demonstrations=record("Pendulum-v1"), seed=0, **options)


def scaled_action(model: CQL) -> float:
    """What the model does in an arbitrary state of the pendulum, whose torques reach 2."""
    return float(model.predict(np.zeros(3, dtype=np.float32), deterministic=True)[0][0]) / 2


def test_every_step_is_one_gradient_step_of_the_other_process(fake: Path) -> None:
    model = make()
    assert scaled_action(model) == pytest.approx(0.0)
    model.learn(7)
    assert model.num_timesteps == 7
    assert scaled_action(model) == pytest.approx(0.07, abs=1e-6)
    played = play_episodes(model, [gym.make("Pendulum-v1", max_episode_steps=5)], 2, seed=0)
    assert played.lengths.tolist() == [5, 5]


def test_a_saved_agent_acts_the_same_and_learns_on(fake: Path, tmp_path: Path) -> None:
    model = make().learn(5)
    model.save(tmp_path / "model.zip")
    loaded = CQL.load(tmp_path / "model.zip")
    assert scaled_action(loaded) == pytest.approx(0.05, abs=1e-6)
    loaded.set_env(gym.make("Pendulum-v1"))
    loaded.learn(3, reset_num_timesteps=False)
    assert loaded.num_timesteps == 8
    loaded.save(tmp_path / "again.zip")
    assert scaled_action(CQL.load(tmp_path / "again.zip", env=gym.make("Pendulum-v1"))) == pytest.approx(0.08, abs=1e-6)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"method_kwargs": {"die_at": 3}}, OSError, r"fake_server.py has ended with exit code 3"),
        ({"method_kwargs": {"refuse": 1}}, ValueError, "fake_server.py: ValueError: net_arch must be a list"),
        ({"learning_rate": 1e-3}, ValueError, "learning_rate has no effect: set actor_learning_rate"),
    ],
)
def test_a_failure_is_one_clear_error(fake: Path, options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make(**options).learn(5)


def test_the_other_process_ends_with_this_one(fake: Path) -> None:
    """It writes to the standard error of this one, which is read until both have closed it."""
    code = (
        "import os, sys; from sb3_actpc.baselines.served import ServerProcess;"
        f"server = ServerProcess([sys.executable, {str(fake)!r}]); os._exit(9)"
    )
    ended = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, timeout=60, check=False)
    assert ended.returncode == 9


def test_without_its_environment_the_command_is_named_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SB3_ACTPC_BASELINES", str(tmp_path / "none"))
    record("SparseHopper-v5").save(tmp_path / "shown.npz")
    assert main(["train", "--env", "SparseHopper-v5", "--algo", "cql", "--demonstrations", "shown.npz", "--no-progress"]) == 2
    assert "run sb3-actpc baselines install d3rlpy" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_a_failing_step_of_the_installation_is_one_line_and_half_an_environment_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SB3_ACTPC_BASELINES", str(tmp_path))
    monkeypatch.setattr("sb3_actpc.baselines.served.PACKAGES", ("--no-such-option",))
    left = tmp_path / "d3rlpy" / "left"
    left.mkdir(parents=True)
    assert main(["baselines", "install", "d3rlpy"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "pip install --no-such-option failed" in error
    assert (tmp_path / "d3rlpy").exists() and not left.exists()  # begun anew
    with pytest.raises(ImportError, match=r"d3rlpy is not installed in .*: run sb3-actpc baselines install d3rlpy"):
        environment_python()


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "falling"), [(BCQ, "vae_loss"), (CQL, "critic_loss")])
def test_the_package_learns_and_is_loaded_again(algorithm: type[ServedAlgorithm], falling: str, tmp_path: Path) -> None:
    """Where it is installed, with the shipped settings but for small batches: the losses fall from the first steps on."""
    try:
        environment_python()
    except ImportError as error:
        pytest.skip(str(error))
    settings = load_preset(algorithm.method.lower(), "default")["method_kwargs"]
    shown = replace(record("Pendulum-v1", 4, 40), actions=np.ones((160, 1)))  # one action, whatever is observed
    options: dict[str, Any] = {"demonstrations": shown, "seed": 0, "batch_size": 16}
    model = algorithm("MlpPolicy", "Pendulum-v1", method_kwargs=settings, **options)
    losses = []
    for _ in range(2):
        model.learn(100, reset_num_timesteps=False, log_interval=None)
        losses.append(model.logger.name_to_value[f"train/{falling}"])
    assert losses[1] < losses[0]
    model.save(tmp_path / "model.zip")
    observations = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    loaded = algorithm.load(tmp_path / "model.zip")
    actions = [one.predict(observations, deterministic=True)[0] for one in (model, loaded)]
    assert np.shape(actions) == (2, 4, 1) and np.isfinite(actions).all() and np.max(np.abs(actions)) <= 2
    if algorithm is CQL:  # BCQ samples actions
        np.testing.assert_array_equal(*actions)
    loaded.set_env(gym.make("Pendulum-v1"))
    loaded.learn(2, reset_num_timesteps=False)
    with pytest.raises(ValueError, match="no_such_setting"):
        algorithm("MlpPolicy", "Pendulum-v1", method_kwargs={"no_such_setting": 1}, **options).learn(1)
