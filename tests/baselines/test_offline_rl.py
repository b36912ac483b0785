"""Methods of d3rlpy, behind a stand-in for it and, where it is installed, as they are."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

import gymnasium as gym
import numpy as np
import pytest

from sb3_actpc.baselines import BCQ, CQL
from sb3_actpc.baselines.offline_rl import D3rlpyAlgorithm
from sb3_actpc.cli import main
from sb3_actpc.experiments.runs import load_preset, play_episodes
from tests.recordings import record


class Learner:
    """Its action is the number of its updates in hundredths."""

    def __init__(self) -> None:
        self.n, self.impl = 0, self

    def create_impl(self, shape: tuple[int, ...], n_actions: int) -> None:
        assert (shape, n_actions) == ((3,), 1)

    def update(self, batch: SimpleNamespace) -> dict[str, float]:
        assert len(batch.rewards) == 100 and abs(batch.actions).max() <= 1 and abs(batch.observations).mean() < 2
        self.n += 1
        return {"loss": 1.0 / self.n}

    def predict(self, rows: np.ndarray) -> np.ndarray:
        return np.full((len(rows), 1), 0.01 * self.n)

    def save_model(self, file: BinaryIO) -> None:
        file.write(bytes([self.n]))

    def load_model(self, file: BinaryIO) -> None:
        self.n = sum(file.read())


@dataclass
class Config:
    batch_size: int
    critic_encoder_factory: Any

    def create(self, device: bool) -> Learner:
        return Learner()


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for d3rlpy."""
    parts = {"models": SimpleNamespace(VectorEncoderFactory=dict), "algos": SimpleNamespace(CQLConfig=Config)}
    monkeypatch.setitem(sys.modules, "d3rlpy", SimpleNamespace(**parts))
    monkeypatch.setitem(sys.modules, "d3rlpy.dataset", SimpleNamespace(TransitionMiniBatch=SimpleNamespace))


def make(**options: Any) -> CQL:
    return CQL("MlpPolicy", "Pendulum-v1", demonstrations=record("Pendulum-v1"), seed=0, **options)


def scaled_action(model: CQL) -> float:
    """What the model does in an arbitrary state of the pendulum, whose torques reach 2."""
    return float(model.predict(np.zeros(3, dtype=np.float32), deterministic=True)[0][0]) / 2


def test_every_step_is_one_gradient_step(fake: None) -> None:
    model = make()
    assert scaled_action(model) == pytest.approx(0.0)
    model.learn(7)
    assert model.num_timesteps == 7
    assert scaled_action(model) == pytest.approx(0.07, abs=1e-6)
    played = play_episodes(model, [gym.make("Pendulum-v1", max_episode_steps=5)], 2, seed=0)
    assert played.lengths.tolist() == [5, 5]


def test_a_saved_agent_acts_the_same_and_learns_on(fake: None, tmp_path: Path) -> None:
    make().learn(5).save(tmp_path / "model.zip")
    loaded = CQL.load(tmp_path / "model.zip")
    assert scaled_action(loaded) == pytest.approx(0.05, abs=1e-6)
    loaded.set_env(gym.make("Pendulum-v1"))
    loaded.learn(3, reset_num_timesteps=False)
    assert loaded.num_timesteps == 8
    loaded.save(tmp_path / "again.zip")
    assert scaled_action(CQL.load(tmp_path / "again.zip", env=gym.make("Pendulum-v1"))) == pytest.approx(0.08, abs=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method_kwargs": {"no_such_setting": 1}}, "no_such_setting"),
        ({"learning_rate": 1e-3}, "learning_rate has no effect: set actor_learning_rate"),
    ],
)
def test_wrong_settings_are_named(fake: None, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_without_d3rlpy_its_installation_is_named_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "d3rlpy", None)
    record("SparseHopper-v5").save(tmp_path / "shown.npz")
    assert main(["train", "--env", "SparseHopper-v5", "--algo", "cql", "--demonstrations", "shown.npz", "--no-progress"]) == 2
    assert "pip install --no-deps d3rlpy" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "falling"), [(BCQ, "vae_loss"), (CQL, "critic_loss")])
def test_the_package_learns_and_is_loaded_again(algorithm: type[D3rlpyAlgorithm], falling: str, tmp_path: Path) -> None:
    """With the shipped settings but for small batches: the losses fall from the first steps on."""
    pytest.importorskip("d3rlpy")
    settings = load_preset(algorithm.method.lower(), "default")["method_kwargs"]
    shown = replace(record("Pendulum-v1", 4, 40), actions=np.ones((160, 1)))  # one action, whatever is observed
    model = algorithm("MlpPolicy", "Pendulum-v1", method_kwargs=settings, demonstrations=shown, seed=0, batch_size=16)
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
