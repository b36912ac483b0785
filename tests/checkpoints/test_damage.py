"""Whatever happens to the files of a checkpoint, the one before is found, or one clear error says what is wrong."""

import errno
import json
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_actpc import ActPC
from sb3_actpc.checkpoints import (
    CheckpointCallback,
    DamagedCheckpoint,
    continue_learning,
    find_bundle,
    list_bundles,
    restore,
)
from sb3_actpc.checkpoints.bundle import VERSION, manifest_hash
from sb3_actpc.utils.weights import check_weights
from tests.actpc.envs import CountingEnv
from tests.checkpoints.runs import assert_same, make_actpc


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


SCRIPT = """
import resource, signal
from sb3_actpc.checkpoints import CheckpointCallback
from sb3_actpc.utils.weights import save_weights
from tests.actpc.envs import CountingEnv
from tests.checkpoints.runs import make_actpc
lines = []
callback = CheckpointCallback({folder!r}, 20, report=lines.append)
model = make_actpc(CountingEnv)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # files may not grow beyond this, as on a full disk
resource.setrlimit(resource.RLIMIT_FSIZE, ({n_bytes}, {n_bytes}))
model.learn(20, callback)
print(lines[0])
{action}
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits of Unix")
@pytest.mark.parametrize(
    ("action", "n_bytes"),
    [*(("callback.save()", n_bytes) for n_bytes in (100, 4000, 20_000)), ("save_weights(model, {folder!r} + '/agent')", 1000)],
)
def test_a_file_for_which_there_is_no_room_is_named(tmp_path: Path, action: str, n_bytes: int) -> None:
    """The first that is too large."""
    folder = str(tmp_path)
    script = SCRIPT.format(folder=folder, n_bytes=n_bytes, action=action.format(folder=folder))
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    told = rf"File too large: '{tmp_path}/\.writing-\w+/\w+\.\w+'"
    assert re.search(f"no checkpoint at step 20: .*{told}", result.stdout), result.stdout + result.stderr
    told = told if action.startswith("callback") else rf"File too large: '{tmp_path}/agent.safetensors'"
    assert result.returncode == 1 and re.search(told, result.stderr.splitlines()[-1])
    assert list(tmp_path.iterdir()) == []


def test_the_newest_is_the_last_written_whatever_the_clock_says(tmp_path: Path) -> None:
    make_actpc(CountingEnv).learn(45, CheckpointCallback(tmp_path, 15))
    for age, path in enumerate(list_bundles(tmp_path)):
        os.utime(path, (1e9 - 1e6 * age, 1e9 - 1e6 * age))
    assert find_bundle(tmp_path).num_timesteps == 45


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
        (lambda: make_actpc(CountingEnv, policy_kwargs={"net_arch": [8, 16]}), "with shape of .*, the agent has shape of"),
        (lambda: make_actpc(CountingEnv, policy_kwargs={"net_arch": [16, 16], "n_critics": 3}), "the agent has shape of"),
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
    file.write_text(json.dumps({**manifest, "sha256": manifest_hash(manifest)}))
    with pytest.raises(ValueError, match=f"format version {VERSION + 1}, this sb3_actpc reads {VERSION}"):
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


# ---------------------------------------------------------------------- NaN and infinity


class PoisonEnv(CountingEnv):
    """Gives one wrong number at one step."""

    def __init__(self, what: str, value: float, at: int) -> None:
        super().__init__()
        self.what, self.value, self.at, self.n_steps = what, value, at, 0

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        self.n_steps += 1
        if self.n_steps == self.at and self.what == "rewards":
            reward = self.value
        elif self.n_steps == self.at:
            observation[self.at % len(observation)] = self.value
        return observation, reward, terminated, truncated, info


class PoisonWeights(BaseCallback):
    """Makes one weight wrong after one step."""

    def __init__(self, value: float, at: int, chosen: random.Random, part: str = "") -> None:
        super().__init__()
        self.value, self.at, self.chosen, self.part = value, at, chosen, part

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            parameters = [value for name, value in self.model.policy.named_parameters() if name.startswith(self.part)]
            weights = self.chosen.choice(parameters).data.view(-1)
            weights[self.chosen.randrange(len(weights))] = self.value
        return True


def random_moment(seed: int) -> tuple[random.Random, float, int]:
    """A generator, a wrong number, and the step at which it comes, after the first checkpoint (step 10)."""
    chosen = random.Random(seed)
    return chosen, chosen.choice([np.nan, np.inf, -np.inf]), chosen.randrange(11, 60)


def small_agent(algorithm: Any, make_env: Any = CountingEnv) -> Any:
    keywords = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 5, "batch_size": 8, "buffer_size": 99, "seed": 0}
    return algorithm("MlpPolicy", make_vec_env(make_env), **keywords)


def assert_good_checkpoint(folder: Path, model: Any, latest: int) -> None:
    """The newest one is from that step, and once the cause is mended an agent goes on from it."""
    restored = restore(model, folder, pytest.fail)
    model.env.envs[0].unwrapped.at = 0
    assert model.num_timesteps == latest
    check_weights(model)
    continue_learning(restored, CheckpointCallback(folder, 10))
    assert model.num_timesteps == 70


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("what", ["rewards", "observations"])
@pytest.mark.parametrize("algorithm", [ActPC, TD3, SAC])
def test_what_is_not_finite_is_named_and_the_last_good_checkpoint_is_there(
    tmp_path: Path, algorithm: Any, what: str, seed: int
) -> None:
    gym.logger.min_level = gym.logger.ERROR
    _, value, at = random_moment(seed)
    make = lambda: small_agent(algorithm, lambda: PoisonEnv(what, value, at))  # noqa: E731
    callback = CheckpointCallback(tmp_path, 10)
    with pytest.raises(ValueError, match=f"environment: {what} are not finite at step {at}"):
        make().learn(70, callback)
    callback.close()
    assert_good_checkpoint(tmp_path, make(), (at - 1) // 10 * 10)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("algorithm", [ActPC, TD3])
def test_a_weight_that_is_not_finite_is_named_and_never_saved(tmp_path: Path, algorithm: Any, seed: int) -> None:
    """By the next checkpoint at the latest."""
    chosen, value, at = random_moment(seed)
    callback = CheckpointCallback(tmp_path, 10)
    with pytest.raises(ValueError, match=r"(agent|actor|critic|generator|prior).*: .* not finite at step") as error:
        small_agent(algorithm).learn(70, [callback, PoisonWeights(value, at, chosen)])
    callback.close()
    step = int(str(error.value).partition("at step ")[2].partition(";")[0])
    assert at <= step <= at // 10 * 10 + 10
    assert_good_checkpoint(tmp_path, small_agent(algorithm), (at - 1) // 10 * 10)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("algorithm", "name"), [(ActPC, "actor"), (TD3, "agent")])
def test_actions_that_are_not_finite_are_named(tmp_path: Path, algorithm: Any, name: str, seed: int) -> None:
    """NaN in the actor reaches its next action, or the critic's next update before it."""
    chosen, _, at = random_moment(seed)
    callback = CheckpointCallback(tmp_path, 100)
    with pytest.raises(ValueError, match=f"{name}: actions are not finite at step"):
        small_agent(algorithm).learn(70, [callback, PoisonWeights(np.nan, at, chosen, "actor.")])
    callback.close()


def test_restoring_in_place_replaces_what_was_learned_since(saved: Path) -> None:
    one, two = make_actpc(CountingEnv), make_actpc(CountingEnv)
    two.learn(150)
    restore(one, saved)
    restore(two, saved)
    assert_same(one, two)


def test_two_runs_with_one_folder_are_told_of_each_other(tmp_path: Path) -> None:
    """The second run replaces the first one's checkpoints; neither a run that goes on nor a resumed one says so."""
    lines: list[str] = []
    callback = CheckpointCallback(tmp_path, 20, report=lines.append)
    first = make_actpc(CountingEnv).learn(40, callback)
    first.learn(20, CheckpointCallback(tmp_path, 20, report=lines.append), reset_num_timesteps=False)
    assert not lines
    make_actpc(CountingEnv).learn(40, CheckpointCallback(tmp_path, 20, report=lines.append))
    assert len(lines) == 1 and "is of another run" in lines[0] and str(tmp_path) in lines[0]
