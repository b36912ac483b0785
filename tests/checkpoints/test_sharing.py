"""Consecutive checkpoints share the files of what has not changed, and each is whole by itself all the same."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from sb3_actpc import ActPC
from sb3_actpc.checkpoints import CheckpointCallback, find_bundle, list_bundles, restore
from sb3_actpc.checkpoints.bundle import write_bundle
from sb3_actpc.checkpoints.state import buffer_arrays
from tests.actpc.envs import CountingEnv
from tests.checkpoints.runs import assert_same
from tests.checkpoints.test_damage import flip
from tests.checkpoints.test_exact_resume import make_actpc

OBSERVATION_BYTES = 3 * 4  # of CountingEnv, one environment


@pytest.fixture(autouse=True)
def small_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """20 observations to a file, and no file too small to be shared."""
    monkeypatch.setattr("sb3_actpc.checkpoints.bundle.SEGMENT", 20 * OBSERVATION_BYTES)
    monkeypatch.setattr("sb3_actpc.checkpoints.bundle.SHARED_FROM", 1)


def learned(folder: Path, n_steps: int, first: int = 45, keep: int = 3) -> ActPC:
    """An agent with a checkpoint at a first step and one at the end; its ring has 50 rows."""
    model = make_actpc(CountingEnv, buffer_size=50)
    return model.learn(n_steps, CheckpointCallback(folder, first, keep=keep))


def files_of_observations(bundle: Path) -> list[Path]:
    return sorted(bundle.glob("buffer_??_observations_*.npy"), key=lambda file: int(file.stem.rpartition("_")[2]))


@pytest.mark.parametrize(
    ("first", "n_steps", "shared"),
    [
        (45, 46, [True, True, False]),  # rows 0 to 19 and 20 to 39 are full, row 45 is new
        (45, 55, [False, True, False]),  # the ring has begun again: row 0 is another
        (60, 119, [False, False, False]),  # once around
    ],
)
def test_only_what_has_changed_is_written(tmp_path: Path, first: int, n_steps: int, shared: list[bool]) -> None:
    model = learned(tmp_path, n_steps, first)
    old, new = (files_of_observations(path) for path in list_bundles(tmp_path))
    assert [one.samefile(other) for one, other in zip(old, new, strict=True)] == shared
    other = make_actpc(CountingEnv, buffer_size=50)
    restore(other, tmp_path)
    assert_same(model, other)


def test_a_checkpoint_stays_whole_when_the_one_it_shares_with_is_removed(tmp_path: Path) -> None:
    model = learned(tmp_path, 46, keep=1)
    assert [path.name for path in tmp_path.iterdir()] == ["000002_step_46"]
    other = make_actpc(CountingEnv, buffer_size=50)
    restore(other, tmp_path)
    assert_same(model, other)


def test_a_damaged_file_is_not_shared(tmp_path: Path) -> None:
    model = learned(tmp_path, 45)
    flip(files_of_observations(list_bundles(tmp_path)[-1])[0])
    model.learn(1, CheckpointCallback(tmp_path, 45), reset_num_timesteps=False)
    assert find_bundle(tmp_path, report=pytest.fail).num_timesteps == 46


def test_without_links_everything_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(*arguments: object) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr("sb3_actpc.checkpoints.bundle.os.link", no_links)
    learned(tmp_path, 46)
    old, new = (files_of_observations(path) for path in list_bundles(tmp_path))
    assert not any(one.samefile(other) for one, other in zip(old, new, strict=True))
    assert find_bundle(tmp_path, report=pytest.fail).num_timesteps == 46


@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (20, 3), (21, 3), (50, 2, 4), (7, 0), (100,)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8, np.bool_])
def test_arrays_come_back_whatever_their_rows(tmp_path: Path, shape: tuple[int, ...], dtype: type) -> None:
    array = np.random.default_rng(0).integers(0, 2, shape).astype(dtype)
    with write_bundle(tmp_path, 0, 1, {}) as writer:
        names = writer.add_array("array", array)
    target = np.ones_like(array)
    bundle = find_bundle(tmp_path)
    bundle.read_array_into(names, target)
    assert target.tobytes() == array.tobytes()
    assert bundle.array_header(names[0])[0][1:] == shape[1:]
    longer = np.ones((len(array) + 1, *shape[1:]), dtype)
    with pytest.raises(ValueError, match="rows, expected"):
        bundle.read_array_into(names, longer)


def test_the_ring_is_what_is_shared() -> None:
    """The arithmetic of this file's first test rests on it: an observation has this many bytes, and all rows are used."""
    arrays = buffer_arrays(make_actpc(CountingEnv, buffer_size=50).replay_buffer)  # type: ignore[arg-type]
    assert arrays["observations"].nbytes == 50 * OBSERVATION_BYTES
