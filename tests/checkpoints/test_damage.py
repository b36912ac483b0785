"""Whatever happens to the files of a checkpoint, the one before is found, or one clear error says what is wrong."""

import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_actpc import ActPC
from sb3_actpc.checkpoints import CheckpointCallback, DamagedCheckpoint, continue_learning, find_bundle, list_bundles, restore
from sb3_actpc.checkpoints.bundle import VERSION, manifest_hash
from sb3_actpc.utils.weights import check_weights
from tests.actpc.envs import CountingEnv
from tests.checkpoints.runs import make_actpc


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three checkpoints of a run."""
    folder = tmp_path_factory.mktemp("saved") / "checkpoints"
    make_actpc(CountingEnv).learn(45, CheckpointCallback(folder, 15))
    assert [find_bundle(path).manifest["num_timesteps"] for path in list_bundles(folder)] == [15, 30, 45]
    return folder


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "truncated": lambda file: file.write_bytes(file.read_bytes()[:-1]),
    "flipped": flip,
    "removed": Path.unlink,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_every_damaged_file_is_named_and_the_checkpoint_before_is_used(tmp_path: Path, saved: Path, damage: str) -> None:
    names = sorted(file.name for file in list_bundles(saved)[-1].iterdir())
    assert "manifest.json" in names and len(names) > 8
    for name in names:
        folder = tmp_path / name
        shutil.copytree(saved, folder)
        newest = list_bundles(folder)[-1]
        DAMAGES[damage](newest / name)
        lines: list[str] = []
        assert find_bundle(folder, lines.append).manifest["num_timesteps"] == 30
        assert len(lines) == 1 and name in lines[0] and str(newest) in lines[0]
        with pytest.raises(DamagedCheckpoint, match=name):
            find_bundle(newest)
    for path in list_bundles(folder):
        (path / "manifest.json").unlink(missing_ok=True)
    with pytest.raises(DamagedCheckpoint, match="all of its 3"):
        find_bundle(folder, lines.append)
    with pytest.raises(FileNotFoundError, match="no checkpoint in"):
        find_bundle(tmp_path / "nowhere")


def test_a_full_disk_leaves_the_old_checkpoints_and_the_training_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[str] = []
    model = make_actpc(CountingEnv)
    callback = CheckpointCallback(tmp_path, 20, report=lines.append)
    model.learn(20, callback)
    before = list_bundles(tmp_path)

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("sb3_actpc.checkpoints.bundle.os.fsync", full)
    model.learn(60, callback, reset_num_timesteps=False)
    assert model.num_timesteps == 80
    assert lines and all(f"No space left on device: '{tmp_path}/.writing-" in line for line in lines)
    assert list(tmp_path.iterdir()) == before
    find_bundle(tmp_path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_actpc("Pendulum-v1"), "env=None, the agent has env='Pendulum-v1'"),
        (lambda: make_actpc(CountingEnv, n_envs=2), "n_envs=1"),
        (lambda: make_actpc(CountingEnv, policy_kwargs={"net_arch": [8, 16]}), "with shape of .*, the agent has shape of"),
        (lambda: make_actpc(CountingEnv, buffer_size=100), r"shape of observations='float32 \(200, 1, 3\)'"),
        (lambda: TD3("MlpPolicy", make_vec_env(CountingEnv), buffer_size=200), "algorithm='ActPC'"),
    ],
)
def test_a_checkpoint_of_something_else_is_refused_and_changes_nothing(saved: Path, make: Any, message: str) -> None:
    model = make()
    weights = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    with pytest.raises(ValueError, match=message):
        restore(model, saved)
    assert all(th.equal(tensor, weights[name]) for name, tensor in model.policy.state_dict().items())
    assert model.num_timesteps == 0 and model.replay_buffer.pos == 0


def test_another_version_is_not_read(tmp_path: Path, saved: Path) -> None:
    shutil.copytree(saved, tmp_path / "newer")
    file = list_bundles(tmp_path / "newer")[-1] / "manifest.json"
    manifest = json.loads(file.read_text())
    manifest["version"] += 1
    del manifest["sha256"]
    file.write_text(json.dumps({**manifest, "sha256": manifest_hash(manifest)}))
    with pytest.raises(ValueError, match=f"format version {VERSION + 1}, this sb3_actpc reads {VERSION}"):
        find_bundle(tmp_path / "newer")


def test_what_a_killed_process_left_is_removed_and_the_last_k_are_kept(tmp_path: Path) -> None:
    left = tmp_path / ".writing-0123"
    left.mkdir()
    (left / "manifest.json").write_text("{}")
    assert list_bundles(tmp_path) == []
    make_actpc(CountingEnv).learn(50, CheckpointCallback(tmp_path, 10, keep=2))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000004_step_40", "000005_step_50"]


# ---------------------------------------------------------------------- NaN and infinity


class PoisonEnv(CountingEnv):
    """Gives wrong numbers once it is told which."""

    poison = ""

    def step(self, action: Any) -> Any:
        observation, reward, *others = super().step(action)
        if self.poison == "observations":
            observation[1] = np.inf
        if self.poison == "rewards":
            reward = np.nan
        return (observation, reward, *others)


class Poison(BaseCallback):
    """After one step the environment gives wrong numbers, or a weight of a part is wrong."""

    def __init__(self, what: str, at: int) -> None:
        super().__init__()
        self.what = what
        self.at = at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            self.training_env.unwrapped.envs[0].unwrapped.poison = self.what
            parts = [weights for name, weights in self.model.policy.named_parameters() if name.startswith(self.what)]
            for weights in parts[:1]:
                weights.data.view(-1)[0] = np.nan
        return True


@pytest.mark.parametrize(
    ("algorithm", "what", "at", "message"),
    [
        (ActPC, "observations", 36, "environment: observations are not finite at step 37"),
        (TD3, "rewards", 36, "environment: rewards are not finite at step 37"),
        (ActPC, "actor.", 35, "actor: actions are not finite at step"),
        (TD3, "actor.", 35, "agent: actions are not finite at step"),
        (TD3, "critic.", 40, "critic.*: weights are not finite at step 40"),
        (ActPC, "generator.", 35, "generator.*: .* not finite at step"),
    ],
)
def test_what_is_not_finite_is_named_and_never_saved(tmp_path: Path, algorithm: Any, what: str, at: int, message: str) -> None:
    """Once the cause is mended, an agent goes on from the checkpoint before."""

    def make() -> Any:
        keywords = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 5, "batch_size": 8, "buffer_size": 99, "seed": 0}
        return algorithm("MlpPolicy", make_vec_env(PoisonEnv), **keywords)

    callback = CheckpointCallback(tmp_path, 10)
    with pytest.raises(ValueError, match=message):
        make().learn(70, [callback, Poison(what, at)])
    callback.close()
    model = make()
    restored = restore(model, tmp_path, pytest.fail)
    assert model.num_timesteps == 30
    check_weights(model)
    continue_learning(restored, CheckpointCallback(tmp_path, 10))
    assert model.num_timesteps == 70
