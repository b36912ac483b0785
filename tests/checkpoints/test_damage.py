"""Whatever happens to the files of a checkpoint, the one before is found, or one clear error says what is wrong."""

import errno
import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.env_util import make_vec_env

from sb3_actpc import ActPC
from sb3_actpc.checkpoints import CheckpointCallback, DamagedCheckpoint, find_bundle, list_bundles, restore
from sb3_actpc.checkpoints.bundle import _manifest_hash
from tests.actpc.envs import CountingEnv
from tests.checkpoints.runs import assert_same
from tests.checkpoints.test_exact_resume import make_actpc


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three checkpoints of a run."""
    folder = tmp_path_factory.mktemp("saved") / "checkpoints"
    make_actpc(CountingEnv).learn(45, CheckpointCallback(folder, 15))
    assert [find_bundle(path).num_timesteps for path in list_bundles(folder)] == [15, 30, 45]
    return folder


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-1])


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


DAMAGES: list[Callable[[Path], Any]] = [truncate, lambda file: file.write_bytes(b""), flip, lambda file: file.unlink()]


@pytest.mark.parametrize("damage", DAMAGES, ids=["truncated", "emptied", "flipped", "removed"])
def test_every_damaged_file_is_named_and_the_checkpoint_before_is_used(tmp_path: Path, saved: Path, damage: Any) -> None:
    names = sorted(file.name for file in list_bundles(saved)[-1].iterdir())
    assert "manifest.json" in names and len(names) > 8
    for name in names:
        folder = tmp_path / name
        shutil.copytree(saved, folder)
        newest = list_bundles(folder)[-1]
        damage(newest / name)
        lines: list[str] = []
        bundle = find_bundle(folder, lines.append)
        assert bundle.num_timesteps == 30
        assert len(lines) == 1 and name in lines[0] and str(newest) in lines[0]
        with pytest.raises(DamagedCheckpoint, match=name):
            find_bundle(newest)


def test_nothing_is_left_to_resume_when_all_are_damaged(tmp_path: Path, saved: Path) -> None:
    shutil.copytree(saved, tmp_path / "all")
    for path in list_bundles(tmp_path / "all"):
        flip(path / "state.json")
    with pytest.warns(UserWarning, match="state.json"), pytest.raises(DamagedCheckpoint, match="all of its 3"):
        find_bundle(tmp_path / "all")
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
    assert lines and all("No space left" in line for line in lines)
    assert list(tmp_path.iterdir()) == before
    find_bundle(tmp_path)


def test_a_folder_that_cannot_be_written_is_refused_before_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="no checkpoint can be written there"):
        make_actpc(CountingEnv).learn(20, CheckpointCallback(tmp_path / "file"))

    def read_only(*arguments: Any, **keywords: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("sb3_actpc.checkpoints.callback.tempfile.TemporaryFile", read_only)
    with pytest.raises(ValueError, match=r"Read-only file system\): choose another folder"):
        make_actpc(CountingEnv).learn(20, CheckpointCallback(tmp_path / "other"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_actpc("Pendulum-v1"), "env='CountingEnv', the agent has env='Pendulum-v1'"),
        (lambda: make_actpc(CountingEnv, n_envs=2), "n_envs=1"),
        (lambda: make_actpc(CountingEnv, policy_kwargs={"net_arch": [8, 16]}), "another network: .* has shape"),
        (lambda: make_actpc(CountingEnv, n_critics=2), "another network"),
        (lambda: make_actpc(CountingEnv, buffer_size=100), "buffer_size=200"),
        (lambda: TD3("MlpPolicy", make_vec_env(CountingEnv), buffer_size=200), "algorithm='ActPC'"),
    ],
)
def test_a_checkpoint_of_something_else_is_refused_and_changes_nothing(saved: Path, make: Any, message: str) -> None:
    model, untouched = make(), make()
    weights = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    with pytest.raises(ValueError, match=message):
        restore(model, saved)
    assert all(th.equal(tensor, weights[name]) for name, tensor in model.policy.state_dict().items())
    assert model.num_timesteps == 0 and model.replay_buffer.pos == 0
    del untouched


def test_another_version_is_not_read(tmp_path: Path, saved: Path) -> None:
    shutil.copytree(saved, tmp_path / "newer")
    file = list_bundles(tmp_path / "newer")[-1] / "manifest.json"
    manifest = json.loads(file.read_text())
    manifest["version"] += 1
    del manifest["sha256"]
    file.write_text(json.dumps({**manifest, "sha256": _manifest_hash(manifest)}))
    with pytest.raises(ValueError, match="format version 3, this sb3_actpc reads 2"):
        find_bundle(tmp_path / "newer")


def test_what_a_killed_process_left_behind_is_removed_and_never_taken_for_a_checkpoint(tmp_path: Path) -> None:
    left = tmp_path / ".writing-0123"
    left.mkdir()
    (left / "manifest.json").write_text("{}")
    assert list_bundles(tmp_path) == []
    make_actpc(CountingEnv).learn(20, CheckpointCallback(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["000001_step_20"]


def test_the_last_k_are_kept(tmp_path: Path) -> None:
    make_actpc(CountingEnv).learn(50, CheckpointCallback(tmp_path, 10, keep=2))
    assert [path.name for path in list_bundles(tmp_path)] == ["000004_step_40", "000005_step_50"]


def test_the_watched_buffer_is_pickled_as_its_own_class(tmp_path: Path) -> None:
    model = make_actpc(CountingEnv)
    original = type(model.replay_buffer)
    callback = CheckpointCallback(tmp_path)
    callback.init_callback(model)
    callback.on_training_start({}, {})
    assert type(model.replay_buffer) is not original and isinstance(model.replay_buffer, original)
    copy = pickle.loads(pickle.dumps(model.replay_buffer))
    assert type(copy) is original
    callback.close()
    assert type(model.replay_buffer) is original


# ---------------------------------------------------------------------- NaN and infinity


class PoisonEnv(CountingEnv):
    """Gives a wrong number at one step."""

    def __init__(self, what: str = "rewards", value: float = np.nan, at: int = 37) -> None:
        super().__init__()
        self.what, self.value, self.at, self.n_steps = what, value, at, 0

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        self.n_steps += 1
        if self.n_steps == self.at and self.what == "rewards":
            reward = self.value
        elif self.n_steps == self.at:
            observation = np.full_like(observation, self.value)
        return observation, reward, terminated, truncated, info


@pytest.mark.parametrize("algorithm", [ActPC, TD3])
@pytest.mark.parametrize("what", ["rewards", "observations"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_named_and_the_last_good_checkpoint_is_there(
    tmp_path: Path, algorithm: Any, what: str, value: float
) -> None:
    gym.logger.min_level = gym.logger.ERROR
    env = make_vec_env(lambda: PoisonEnv(what, value))
    model = algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, learning_starts=10, batch_size=8, buffer_size=99)
    with pytest.raises(ValueError, match=f"environment: {what} are not finite at step 37"):
        model.learn(60, CheckpointCallback(tmp_path, 10))
    assert find_bundle(tmp_path).num_timesteps == 30


@pytest.mark.parametrize(("algorithm", "name"), [(ActPC, r"critic\.0\.weights\.1"), (TD3, r"critic\.qf0\.2\.weight")])
def test_weights_that_are_not_finite_are_never_saved(tmp_path: Path, algorithm: Any, name: str) -> None:
    model = algorithm("MlpPolicy", make_vec_env(CountingEnv), policy_kwargs={"net_arch": [8]}, buffer_size=99)
    callback = CheckpointCallback(tmp_path, 10)
    model.learn(20, callback)
    model.policy.state_dict()[name.replace("\\", "")].fill_(np.nan)
    with pytest.raises(ValueError, match=f"{name}: weights are not finite at step 30"):
        model.learn(60, callback, reset_num_timesteps=False)
    callback.close()
    assert find_bundle(tmp_path).num_timesteps == 20


def test_actions_that_are_not_finite_are_named(tmp_path: Path) -> None:
    model = make_actpc(CountingEnv)
    callback = CheckpointCallback(tmp_path, 10)
    model.learn(20, callback)
    model.actor.circuit.weights[0].fill_(np.nan)
    with pytest.raises(ValueError, match="actor: actions are not finite at step 20"):
        model.learn(60, callback, reset_num_timesteps=False)
    callback.close()


def test_restoring_in_place_replaces_what_was_learned_since(saved: Path) -> None:
    one, two = make_actpc(CountingEnv), make_actpc(CountingEnv)
    two.learn(150)
    restore(one, saved)
    restore(two, saved)
    assert_same(one, two)
