"""Demonstrations: what is accepted, what is refused and by which name, and that files give back what was put in."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_actpc.demonstrations import Demonstrations, fit_demonstrations, resolve, shipped_demonstrations
from sb3_actpc.demonstrations.minari import episode_buffer
from sb3_actpc.demonstrations.npz import FORMAT_VERSION
from sb3_actpc.utils.files import atomic_write

OBS_DIM, ACTION_DIM = 4, 2
LENGTHS = (3, 1, 5)
N = sum(LENGTHS)


def make_fields(lengths: tuple[int, ...] = LENGTHS, seed: int = 0) -> dict[str, Any]:
    """Fields of episodes with the given lengths; the second one is cut by a time limit."""
    rng = np.random.default_rng(seed)
    walks = [rng.normal(size=(length + 1, OBS_DIM)).astype(np.float32) for length in lengths]
    ends = np.cumsum(lengths) - 1
    n_transitions = sum(lengths)
    terminations = np.zeros(n_transitions, dtype=bool)
    terminations[ends] = True
    if len(lengths) > 1:
        terminations[ends[1]] = False
    return {
        "observations": np.concatenate([walk[:-1] for walk in walks]),
        "actions": rng.uniform(-1, 1, size=(n_transitions, ACTION_DIM)).astype(np.float32),
        "next_observations": np.concatenate([walk[1:] for walk in walks]),
        "rewards": terminations.astype(np.float32),
        "terminations": terminations,
        "episode_starts": np.concatenate([[0], ends[:-1] + 1]),
        "env_id": "TinyReach-v0",
        "dense_rewards": rng.normal(size=n_transitions).astype(np.float32),
        "metadata": {"command": "collect --seed 0", "seed": 0, "success": None},
    }


STORED_NAMES = sorted(
    {*make_fields(), "format_version", "next_observation_rows", "next_observation_indices"} - {"next_observations"}
)


def make_demonstrations(**changes: Any) -> Demonstrations:
    return Demonstrations(**{**make_fields(), **changes})


def buffer_of(demonstrations: Demonstrations, *spaces_of: spaces.Space[Any]) -> Any:
    """The first episode as Minari's buffer."""
    return episode_buffer(next(demonstrations.episodes), *spaces_of)


def assert_equal(left: Demonstrations, right: Demonstrations) -> None:
    """Equal types, shapes, bits and texts in every field but the file name."""
    for entry in dataclasses.fields(Demonstrations):
        mine, other = getattr(left, entry.name), getattr(right, entry.name)
        if isinstance(mine, np.ndarray):
            assert mine.dtype == other.dtype and mine.shape == other.shape, entry.name
            assert mine.tobytes() == other.tobytes(), entry.name
        elif entry.name != "source":
            assert mine == other, entry.name


def rewrite(path: Path, **changes: Any) -> Path:
    """Store the entries of an npz file again, some of them changed or, given None, left out."""
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    arrays.update(changes)
    np.savez_compressed(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "demonstrations.npz"
    make_demonstrations().save(path)
    return path


class TestFields:
    def test_arrays_are_converted_to_the_documented_types(self) -> None:
        fields = make_fields()
        demonstrations = make_demonstrations(
            observations=fields["observations"].astype(np.float64),
            actions=fields["actions"].tolist(),
            terminations=fields["terminations"].astype(np.int64),
            episode_starts=fields["episode_starts"].astype(np.int32),
            rewards=fields["rewards"].astype(np.int64),
        )
        assert_equal(demonstrations, make_demonstrations())
        assert demonstrations.observations.dtype == demonstrations.rewards.dtype == np.float32
        assert demonstrations.terminations.dtype == bool
        assert demonstrations.episode_starts.dtype == np.int64

    def test_fields_cannot_be_reassigned(self) -> None:
        with pytest.raises(dataclasses.FrozenInstanceError):
            make_demonstrations().env_id = "Other-v0"  # type: ignore[misc]

    def test_metadata_is_a_copy_in_json_form(self) -> None:
        metadata = {"lengths": (1, 2)}
        demonstrations = make_demonstrations(metadata=metadata)
        metadata["lengths"] = (3, 4)
        assert demonstrations.metadata == {"lengths": [1, 2]}

    def test_bounds_cover_every_transition_once(self) -> None:
        demonstrations = make_demonstrations()
        assert len(demonstrations) == N
        assert demonstrations.n_episodes == len(LENGTHS)
        bounds = demonstrations.episode_bounds
        assert bounds.dtype == np.int64 and bounds.shape == (3, 2)
        assert np.concatenate([np.arange(start, end) for start, end in bounds]).tolist() == list(range(N))
        assert (bounds[:, 1] - bounds[:, 0]).tolist() == list(LENGTHS)

    def test_returns_are_the_sums_of_each_episode(self) -> None:
        rewards = np.arange(N)
        demonstrations = make_demonstrations(rewards=rewards, dense_rewards=2 * rewards)
        assert demonstrations.episode_returns.tolist() == [0 + 1 + 2, 3, 4 + 5 + 6 + 7 + 8]
        assert demonstrations.dense_returns is not None
        assert demonstrations.dense_returns.tolist() == [6, 6, 60]

    def test_dense_returns_are_none_without_dense_rewards(self) -> None:
        assert make_demonstrations(dense_rewards=None).dense_returns is None

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("observations", np.zeros((0, OBS_DIM))),
            ("observations", np.zeros(N)),
            ("observations", np.zeros((N, OBS_DIM, 1))),
            ("observations", np.full((N, OBS_DIM), "1")),
            ("observations", np.zeros((N, OBS_DIM), dtype=object)),
            ("observations", [[1.0], [1.0, 2.0]]),
            ("observations", np.zeros((N, OBS_DIM), dtype=complex)),
            ("actions", np.zeros((N - 1, ACTION_DIM))),
            ("actions", np.zeros(N)),
            ("actions", np.zeros((N, 0))),
            ("next_observations", np.zeros((N, OBS_DIM + 1))),
            ("next_observations", np.zeros((N + 1, OBS_DIM))),
            ("rewards", np.zeros(N + 1)),
            ("rewards", np.zeros((N, 1))),
            ("rewards", 0.0),
            ("dense_rewards", np.zeros(N - 1)),
            ("terminations", np.zeros(N - 1, dtype=bool)),
            ("terminations", np.full(N, 0.5)),
            ("terminations", np.full(N, np.nan)),
            ("terminations", np.ones(N, dtype=bool)),
            ("episode_starts", []),
            ("episode_starts", [1, 3]),
            ("episode_starts", [0, 4, 4]),
            ("episode_starts", [0, 4, 3]),
            ("episode_starts", [0, N]),
            ("episode_starts", [0.0, 3.0]),
            ("episode_starts", [[0, 3]]),
            ("env_id", ""),
            ("env_id", None),
            ("metadata", {"nested": {"a": 1}}),
            ("metadata", {1: "number as key"}),
            ("metadata", {"array": np.zeros(2)}),
            ("metadata", {"nan": float("nan")}),
            ("metadata", "text"),
        ],
    )
    def test_a_field_that_does_not_fit_is_refused_by_name(self, field: str, value: Any) -> None:
        with pytest.raises(ValueError, match=f"field '{field}': expected .*, found "):
            make_demonstrations(**{field: value})

    @pytest.mark.parametrize("field", ["observations", "actions", "next_observations", "rewards", "dense_rewards"])
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
    def test_values_that_float32_cannot_hold_are_refused_with_their_place(self, field: str, value: float) -> None:
        values = make_fields()[field].astype(np.float64)
        values[(2,) * values.ndim if values.ndim == 1 else (2, 1)] = value
        with pytest.raises(ValueError, match=rf"field '{field}'.*at index \(2,"):
            make_demonstrations(**{field: values})


class TestSelect:
    def test_first_episodes(self) -> None:
        whole, selection = make_demonstrations(), make_demonstrations().select(n_episodes=2)
        assert selection.episode_starts.tolist() == [0, 3]
        assert len(selection) == 4
        assert selection.dense_rewards is not None and len(selection.dense_rewards) == 4
        assert np.array_equal(selection.next_observations, whole.next_observations[:4])
        assert selection.metadata == whole.metadata

    def test_first_transitions_cut_the_last_episode(self) -> None:
        selection = make_demonstrations().select(n_transitions=6)
        assert selection.episode_bounds.tolist() == [[0, 3], [3, 4], [4, 6]]
        assert not selection.terminations[-1]

    def test_a_cut_between_episodes_adds_no_empty_one(self) -> None:
        assert make_demonstrations().select(n_transitions=4).episode_bounds.tolist() == [[0, 3], [3, 4]]

    def test_both_limits_apply(self) -> None:
        assert make_demonstrations().select(n_episodes=2, n_transitions=2).episode_bounds.tolist() == [[0, 2]]

    def test_all_of_it_is_equal(self) -> None:
        whole = make_demonstrations()
        assert_equal(whole.select(), whole)
        assert_equal(whole.select(n_episodes=3), whole)
        assert_equal(whole.select(n_transitions=N), whole)

    @pytest.mark.parametrize("count", [0, -1, 1000, 1.5, True, "2"])
    @pytest.mark.parametrize("name", ["n_episodes", "n_transitions"])
    def test_more_than_there_is_or_no_whole_number_is_refused(self, name: str, count: Any) -> None:
        with pytest.raises(ValueError, match=f"{name} must be a whole number from 1 to .*found"):
            make_demonstrations().select(**{name: count})

    def test_transitions_beyond_the_selected_episodes_are_refused(self) -> None:
        with pytest.raises(ValueError, match="n_transitions must be a whole number from 1 to 3, found 4"):
            make_demonstrations().select(n_episodes=1, n_transitions=4)


class TestCheck:
    observation_space = spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float64)
    action_space = spaces.Box(-1, 1, (ACTION_DIM,), np.float32)

    def test_fitting_spaces_pass(self) -> None:
        make_demonstrations().check(self.observation_space, self.action_space, "TinyReach-v0")

    def test_a_dict_space_of_the_same_flat_size_passes(self) -> None:
        part = spaces.Box(-1, 1, (2,))
        make_demonstrations().check(spaces.Dict(goal=part, state=part), self.action_space)

    @pytest.mark.parametrize("env_id", ["TinyReach-v5", "TinyReach", "some.module:TinyReach-v1"])
    def test_another_version_of_the_environment_passes(self, env_id: str) -> None:
        make_demonstrations().check(self.observation_space, self.action_space, env_id)

    @pytest.mark.parametrize("env_id", ["TinyPush-v0", "TinyReach2-v0", "TinyReach-v0-extra", ""])
    def test_another_environment_is_refused(self, env_id: str) -> None:
        with pytest.raises(ValueError, match=f"'env_id': expected '{env_id}'.* found 'TinyReach-v0'"):
            make_demonstrations().check(self.observation_space, self.action_space, env_id)

    def test_another_observation_size_is_refused(self) -> None:
        with pytest.raises(ValueError, match="'observations': expected 5 values a row, found 4"):
            make_demonstrations().check(spaces.Box(-1, 1, (5,)), self.action_space)

    def test_another_action_size_is_refused(self) -> None:
        with pytest.raises(ValueError, match="'actions': expected 3 values a row, found 2"):
            make_demonstrations().check(self.observation_space, spaces.Box(-1, 1, (3,)))

    def test_a_discrete_action_space_is_refused(self) -> None:
        with pytest.raises(ValueError, match="'actions': expected a Box"):
            make_demonstrations().check(self.observation_space, spaces.Discrete(2))

    @pytest.mark.parametrize(("excess", "fits"), [(5e-5, True), (2e-4, False), (1.0, False)])
    @pytest.mark.parametrize("side", [-1, 1])
    def test_actions_may_leave_their_bounds_by_a_rounding_only(self, excess: float, fits: bool, side: int) -> None:
        actions = make_fields()["actions"]
        actions[4, 1] = side * (1 + excess)
        demonstrations = make_demonstrations(actions=actions)
        if fits:
            demonstrations.check(self.observation_space, self.action_space)
        else:
            with pytest.raises(ValueError, match=r"'actions': expected values in \[-1.0, 1.0\] in column 1.*transition 4"):
                demonstrations.check(self.observation_space, self.action_space)

    def test_bounds_are_in_environment_units(self) -> None:
        demonstrations = make_demonstrations(actions=np.tile([0.3, 30.0], (N, 1)))
        demonstrations.check(self.observation_space, spaces.Box(np.array([0.2, 20]), np.array([0.4, 40]), dtype=np.float64))

    def test_the_loaded_file_is_named(self, saved: Path) -> None:
        with pytest.raises(ValueError, match=r"demonstrations\.npz: .*'env_id'"):
            Demonstrations.load(saved).check(self.observation_space, self.action_space, "Other-v0")


class TestFile:
    def test_round_trip_is_equal_bit_for_bit_also_at_the_ends_of_episodes(self, saved: Path) -> None:
        loaded = Demonstrations.load(saved)
        assert_equal(loaded, make_demonstrations())
        ends = loaded.episode_bounds[:, 1] - 1
        assert np.array_equal(loaded.next_observations[ends], make_fields()["next_observations"][ends])

    def test_round_trip_without_dense_rewards_and_metadata(self, tmp_path: Path) -> None:
        demonstrations = make_demonstrations(dense_rewards=None, metadata={})
        demonstrations.save(tmp_path / "plain.npz")
        assert_equal(Demonstrations.load(tmp_path / "plain.npz"), demonstrations)

    def test_round_trip_of_a_single_transition(self, tmp_path: Path) -> None:
        demonstrations = Demonstrations(**make_fields(lengths=(1,)))
        demonstrations.save(tmp_path / "one.npz")
        assert_equal(Demonstrations.load(tmp_path / "one.npz"), demonstrations)

    def test_round_trip_of_jumps_within_an_episode_and_of_minus_zero(self, tmp_path: Path) -> None:
        fields = make_fields()
        fields["observations"][1], fields["next_observations"][0] = 0.0, -0.0  # equal numbers, other bits
        fields["next_observations"][5] += 1.0
        demonstrations = Demonstrations(**fields)
        demonstrations.save(tmp_path / "jumps.npz")
        assert_equal(Demonstrations.load(tmp_path / "jumps.npz"), demonstrations)

    def test_text_that_is_not_ascii_survives(self, tmp_path: Path) -> None:
        demonstrations = make_demonstrations(metadata={"author": "Zoë — 李\0\n"})
        demonstrations.save(tmp_path / "text.npz")
        assert Demonstrations.load(tmp_path / "text.npz").metadata == {"author": "Zoë — 李\0\n"}

    def test_saving_again_gives_the_same_bytes(self, saved: Path) -> None:
        first = saved.read_bytes()
        Demonstrations.load(saved).save(saved)
        assert saved.read_bytes() == first

    def test_the_name_is_kept_as_given(self, tmp_path: Path) -> None:
        make_demonstrations().save(tmp_path / "no_suffix")
        assert os.listdir(tmp_path) == ["no_suffix"]

    def test_next_observations_are_not_stored_twice(self, tmp_path: Path) -> None:
        demonstrations = Demonstrations(**make_fields(lengths=(500, 500)))
        demonstrations.save(tmp_path / "once.npz")
        with np.load(tmp_path / "once.npz") as archive:
            assert archive["next_observation_indices"].tolist() == [499, 999]
        np.savez_compressed(tmp_path / "twice.npz", a=demonstrations.observations, b=demonstrations.next_observations)
        of_the_rest = demonstrations.actions.nbytes + 3 * demonstrations.rewards.nbytes
        assert (tmp_path / "once.npz").stat().st_size < 0.55 * (tmp_path / "twice.npz").stat().st_size + of_the_rest

    def test_nothing_is_pickled(self, saved: Path) -> None:
        with np.load(saved, allow_pickle=False) as archive:
            assert all(archive[name].dtype.kind in "fibU" for name in archive.files)

    def test_missing_file_is_one_clear_line(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError) as caught:
            Demonstrations.load(tmp_path / "nowhere.npz")
        assert str(caught.value) == f"no demonstrations file at {tmp_path / 'nowhere.npz'}"

    def test_a_folder_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="found a folder"):
            Demonstrations.load(tmp_path)

    def test_a_file_cut_short_anywhere_is_refused(self, saved: Path) -> None:
        content = saved.read_bytes()
        for length in range(0, len(content), 7):
            saved.write_bytes(content[:length])
            with pytest.raises(ValueError, match=r"demonstrations\.npz: "):
                Demonstrations.load(saved)

    def test_a_flipped_bit_is_refused_or_harmless(self, saved: Path) -> None:
        content = saved.read_bytes()
        expected = make_demonstrations()
        rng = np.random.default_rng(0)
        refused = 0
        for position in range(0, len(content), 3):
            damaged = bytearray(content)
            damaged[position] ^= 1 << int(rng.integers(8))
            saved.write_bytes(bytes(damaged))
            try:
                assert_equal(Demonstrations.load(saved), expected)
            except ValueError as error:
                assert "demonstrations.npz: " in str(error)
                refused += 1
        assert refused > 0

    @pytest.mark.parametrize("content", [b"", b"\0" * 500, b"PK\x03\x04", b"not a zip file", b"\x93NUMPY\x01\x00v\x00"])
    def test_other_content_is_refused(self, tmp_path: Path, content: bytes) -> None:
        path = tmp_path / "other.npz"
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"other\.npz: expected a demonstrations \.npz file"):
            Demonstrations.load(path)

    @pytest.mark.parametrize("name", STORED_NAMES)
    def test_a_missing_entry_is_refused_by_name(self, saved: Path, name: str) -> None:
        with pytest.raises(ValueError, match=rf"demonstrations\.npz: demonstrations field '{name}': expected an entry"):
            Demonstrations.load(rewrite(saved, **{name: None}))

    @pytest.mark.parametrize("name", STORED_NAMES)
    def test_pickled_objects_are_refused_by_name_and_never_run(self, saved: Path, tmp_path: Path, name: str) -> None:
        marker = tmp_path / "was_run"
        with pytest.raises(ValueError, match=rf"demonstrations\.npz: demonstrations field '{name}'"):
            Demonstrations.load(rewrite(saved, **{name: np.array([Payload(str(marker))], dtype=object)}))
        assert not marker.exists()

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("observations", np.full((N, OBS_DIM), "1")),
            ("observations", np.zeros(N, dtype=np.float32)),
            ("observations", np.zeros((0, OBS_DIM), dtype=np.float32)),
            ("observations", np.full((N, OBS_DIM), np.nan, dtype=np.float32)),
            ("actions", np.full((N, ACTION_DIM), "1")),
            ("actions", np.full((N, ACTION_DIM), np.inf)),
            ("rewards", np.zeros(N + 1)),
            ("dense_rewards", np.zeros(N + 1)),
            ("terminations", np.full(N, "yes")),
            ("episode_starts", np.array([], dtype=np.int64)),
            ("episode_starts", np.array([0.0, 3.0, 4.0])),
            ("next_observation_rows", np.zeros((2, OBS_DIM), dtype=np.float32)),
            ("next_observation_rows", np.full((3, OBS_DIM), "1")),
            ("next_observation_indices", np.array([2, 3, N])),
            ("next_observation_indices", np.array([-1, 2, 3])),
            ("next_observation_indices", np.array([3, 2, 8])),
            ("next_observation_indices", np.array([1, 3, 8])),
            ("next_observation_indices", np.array([2.0, 3.0, 8.0])),
            ("env_id", np.array(3)),
            ("env_id", np.array("{broken")),
            ("env_id", np.array("3")),
            ("env_id", np.array(['"A-v0"', '"B-v0"'])),
            ("metadata", np.array("[1]")),
            ("metadata", np.array('{"a": NaN}')),
            ("format_version", np.array(FORMAT_VERSION + 1)),
            ("format_version", np.array(0)),
            ("format_version", np.array("1")),
            ("format_version", np.array([1])),
        ],
    )
    def test_a_wrong_entry_is_refused_by_file_and_name(self, saved: Path, name: str, value: np.ndarray) -> None:
        with pytest.raises(ValueError, match=rf"demonstrations\.npz: demonstrations field '{name}': expected .*, found "):
            Demonstrations.load(rewrite(saved, **{name: value}))

    def test_a_newer_format_asks_for_an_update(self, saved: Path) -> None:
        with pytest.raises(ValueError, match=f"'format_version': expected at most {FORMAT_VERSION} .update"):
            Demonstrations.load(rewrite(saved, format_version=np.array(FORMAT_VERSION + 1)))

    def test_an_entry_that_claims_a_huge_shape_is_refused(self, saved: Path) -> None:
        with zipfile.ZipFile(saved) as archive:
            entries = {name: archive.read(name) for name in archive.namelist()}
        header = entries["rewards.npy"]
        old = f"({N},)".encode()
        huge = b"(1" + b"0" * 17 + b",)"
        entries["rewards.npy"] = header.replace(old + b", }" + b" " * (len(huge) - len(old)), huge + b", }", 1)
        assert huge in entries["rewards.npy"] and len(header) == len(entries["rewards.npy"])
        with zipfile.ZipFile(saved, "w") as archive:
            for name, content in entries.items():
                archive.writestr(name, content)
        with pytest.raises(ValueError, match="'rewards': expected a readable array"):
            Demonstrations.load(saved)

    def test_an_interrupted_save_leaves_the_old_file_and_nothing_else(
        self, saved: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        before = saved.read_bytes()

        def fail_halfway(file: Any, **arrays: Any) -> None:
            file.write(b"half")
            raise OSError("disk full")

        monkeypatch.setattr(np, "savez_compressed", fail_halfway)
        with pytest.raises(OSError, match="disk full"):
            make_demonstrations(rewards=np.ones(N)).save(saved)
        assert saved.read_bytes() == before
        assert os.listdir(saved.parent) == [saved.name]

    def test_resolve_takes_paths_and_demonstrations(self, saved: Path) -> None:
        demonstrations = make_demonstrations()
        assert resolve(demonstrations) is demonstrations
        assert_equal(resolve(saved), demonstrations)
        assert_equal(resolve(str(saved)), demonstrations)

    @pytest.mark.parametrize("source", [None, 3, {"observations": []}])
    def test_resolve_refuses_anything_else(self, source: Any) -> None:
        with pytest.raises(ValueError, match="must be a file path, a Minari id or a Demonstrations object, found"):
            resolve(source)


class Payload:
    """Unpickling this makes a folder, which a reader that never unpickles does not."""

    def __init__(self, marker: str) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return os.mkdir, (self.marker,)


class TestAtomicWrite:
    def test_the_old_content_is_readable_until_the_block_ends(self, tmp_path: Path) -> None:
        path = tmp_path / "file.txt"
        path.write_text("old")
        with atomic_write(path, "w") as file:
            file.write("new ü\n")
            assert path.read_text() == "old"
        assert path.read_bytes() == "new ü\n".encode()
        assert os.listdir(tmp_path) == ["file.txt"]

    @pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
    def test_an_error_leaves_no_trace(self, tmp_path: Path, error: type[BaseException]) -> None:
        with pytest.raises(error), atomic_write(tmp_path / "file.bin") as file:
            file.write(b"half")
            raise error
        assert os.listdir(tmp_path) == []

    def test_missing_folders_are_made(self, tmp_path: Path) -> None:
        with atomic_write(tmp_path / "a" / "b" / "file.bin") as file:
            file.write(b"x")
        assert (tmp_path / "a" / "b" / "file.bin").read_bytes() == b"x"

    def test_permissions_of_the_old_file_are_kept(self, tmp_path: Path) -> None:
        path = tmp_path / "file.bin"
        path.touch()
        path.chmod(0o640)
        with atomic_write(path) as file:
            file.write(b"x")
        assert path.stat().st_mode & 0o777 == 0o640

    def test_a_link_is_followed(self, tmp_path: Path) -> None:
        (tmp_path / "target.bin").write_bytes(b"old")
        (tmp_path / "link.bin").symlink_to("target.bin")
        with atomic_write(tmp_path / "link.bin") as file:
            file.write(b"new")
        assert (tmp_path / "link.bin").is_symlink()
        assert (tmp_path / "target.bin").read_bytes() == b"new"

    def test_a_folder_is_not_overwritten(self, tmp_path: Path) -> None:
        (tmp_path / "folder").mkdir()
        with pytest.raises(IsADirectoryError), atomic_write(tmp_path / "folder"):
            pass
        assert os.listdir(tmp_path) == ["folder"]

    def test_another_mode_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="found 'a'"):
            atomic_write(tmp_path / "file", "a").__enter__()  # type: ignore[arg-type]


class TinyReach(gym.Env[Any, Any]):
    """Spaces only: the state before the goal, an order that is not alphabetical."""

    observation_space = spaces.Dict(
        state=spaces.Box(-np.inf, np.inf, (3,), np.float64), goal=spaces.Box(-np.inf, np.inf, (1, 1), np.float64)
    )
    action_space = spaces.Box(-1, 1, (1, ACTION_DIM), np.float32)


@pytest.fixture
def tiny_reach() -> Iterator[str]:
    env_id = "TinyReach-v0"
    gym.register(env_id, entry_point=lambda **options: TinyReach(), max_episode_steps=5)
    yield env_id
    del gym.registry[env_id]


@pytest.mark.filterwarnings("ignore:.*is set to None:UserWarning", "ignore:env_spec is None:UserWarning")
class TestMinari:
    @pytest.fixture(autouse=True)
    def minari(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
        pytest.importorskip("h5py")
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
        return pytest.importorskip("minari")

    @pytest.mark.parametrize("dense", [True, False])
    def test_round_trip_of_an_unregistered_environment(self, dense: bool) -> None:
        demonstrations = make_demonstrations(**({} if dense else {"dense_rewards": None}))
        dataset = demonstrations.to_minari("tiny/plain-v0")
        assert dataset.total_episodes == len(LENGTHS) and dataset.total_steps == N
        assert_equal(Demonstrations.from_minari(dataset), demonstrations)
        assert_equal(Demonstrations.from_minari("tiny/plain-v0"), demonstrations)

    def test_round_trip_of_a_dict_observation_in_any_key_order(self, tiny_reach: str) -> None:
        demonstrations = make_demonstrations()
        dataset = demonstrations.to_minari("tiny/dict-v0")
        episode = dataset[0]
        assert episode.observations["state"].shape == (4, 3) and episode.observations["goal"].shape == (4, 1, 1)
        assert_equal(Demonstrations.from_minari("tiny/dict-v0"), demonstrations)

    def test_rows_equal_gymnasiums_flatten(self, minari: Any) -> None:
        from minari.data_collector import EpisodeBuffer

        space = spaces.Dict(b=spaces.Box(-1, 1, (2, 2)), a=spaces.Dict(c=spaces.Box(-1, 1, (1,)), d=spaces.Box(-1, 1, (2,))))
        space.seed(0)
        samples = [space.sample() for _ in range(4)]
        stacked = {
            "b": np.stack([sample["b"] for sample in samples]),
            "a": {key: np.stack([sample["a"][key] for sample in samples]) for key in "cd"},
        }
        buffer = EpisodeBuffer(
            observations=stacked,
            actions=np.zeros((3, 2), dtype=np.float32),
            rewards=[0.0, 0.0, 1.0],
            terminations=[False, False, True],
            truncations=[False] * 3,
        )
        action_space = spaces.Box(-1, 1, (2,))
        minari.create_dataset_from_buffers("tiny/nested-v0", [buffer], observation_space=space, action_space=action_space)
        for order in (None, space):
            found = Demonstrations.from_minari("tiny/nested-v0", env_id="TinyReach-v0", observation_space=order)
            flat_space = order or minari.load_dataset("tiny/nested-v0").observation_space
            expected = np.stack([np.asarray(spaces.utils.flatten(flat_space, sample)) for sample in samples])
            assert np.array_equal(found.observations, expected[:-1])
            assert np.array_equal(found.next_observations, expected[1:])
            assert found.rewards.tolist() == [0, 0, 1] and found.terminations.tolist() == [False, False, True]
            assert found.dense_rewards is None

    def test_the_environment_can_be_recovered(self, minari: Any) -> None:
        with gym.make("Pendulum-v1") as env:
            make_demonstrations(
                observations=np.zeros((N, 3)),
                next_observations=np.zeros((N, 3)),
                actions=np.zeros((N, 1)),
                env_id="Pendulum-v1",
            ).to_minari("tiny/pendulum-v0", env=env, author="A. Tester", description="zeros")
        dataset = minari.load_dataset("tiny/pendulum-v0")
        assert dataset.recover_environment().spec.id == "Pendulum-v1"
        assert Demonstrations.from_minari(dataset).env_id == "Pendulum-v1"

    @pytest.mark.parametrize(("shape", "is_image"), [((4, 4, 3), False), ((36, 36), True)])
    def test_images_which_it_would_change_are_refused(self, shape: tuple[int, ...], is_image: bool) -> None:
        """It keeps none as JPEG that is smaller than 32 by 32."""
        env: Any = gym.Env()
        images, joints = spaces.Box(0, 255, shape, np.uint8), spaces.Box(-1e4, 1e4, (2,))
        env.observation_space = spaces.Dict({"camera": images, "joints": joints})
        env.action_space = spaces.Box(-9, 9, (ACTION_DIM,))
        seen = np.arange(N + 1)[:, None] + np.arange(spaces.utils.flatdim(env.observation_space))
        shown = make_demonstrations(observations=seen[:-1] % 256, next_observations=seen[1:] % 256)
        if is_image:
            with pytest.raises(ValueError, match=r"Minari stores images such as Box\(0, 255, .*: keep them with save"):
                shown.to_minari("tiny/images-v0", env)
        else:
            assert_equal(Demonstrations.from_minari(shown.to_minari("tiny/images-v0", env)), shown)

    @pytest.mark.parametrize(
        ("space", "is_kept"),
        [
            (spaces.Box(0, 255, (8,), np.uint8), False),
            (spaces.Box(0, 255, (4, 5), np.uint8), False),
            (spaces.Box(0, 255, (40, 33), np.uint8), True),  # an image: Minari decodes it
            (spaces.Box(0, 255, (8,), np.int64), True),
            (spaces.Box(-1, 1, (3, 2)), True),
        ],
    )
    @pytest.mark.parametrize("is_dict", [False, True])
    def test_rows_that_are_not_of_the_datasets_own_space_are_refused(
        self, space: spaces.Box, is_kept: bool, is_dict: bool, minari: Any
    ) -> None:
        """Minari stores every uint8 vector as JPEG and gives back its bytes."""
        from minari.data_collector import EpisodeBuffer

        space.seed(0)
        rows: Any = np.stack([space.sample() for _ in range(4)])
        whole: spaces.Space[Any] = spaces.Dict(state=space, time=spaces.Box(0, 9, (1,))) if is_dict else space
        seen = {"state": rows, "time": np.zeros((4, 1), np.float32)} if is_dict else rows
        ends = {"rewards": [0.0] * 3, "terminations": [False] * 3, "truncations": [False] * 3}
        episode = EpisodeBuffer(observations=seen, actions=np.zeros((3, 2), np.float32), **ends)
        dataset = minari.create_dataset_from_buffers(
            "tiny/bytes-v0", [episode], observation_space=whole, action_space=spaces.Box(-1, 1, (2,))
        )
        if not is_kept:
            name = "observations/state" if is_dict else "observations"
            expected = rf"tiny/bytes-v0: episode 0: .*'{name}': expected rows of shape .*, found .*stored them as JPEG"
            with pytest.raises(ValueError, match=expected):
                Demonstrations.from_minari(dataset, env_id="Named-v0")
            return
        read = Demonstrations.from_minari(dataset, env_id="Named-v0").observations
        assert read.shape == (3, rows[0].size + is_dict)
        if space.dtype != np.uint8:
            assert np.array_equal(read[:, : rows[0].size], rows[:3].reshape(3, -1).astype(np.float32))

    def test_truncation_and_termination_are_told_apart(self) -> None:
        dataset = make_demonstrations().to_minari("tiny/ends-v0")
        ends = [(bool(episode.terminations[-1]), bool(episode.truncations[-1])) for episode in dataset.iterate_episodes()]
        assert ends == [(True, False), (False, True), (True, False)]

    def test_a_dense_reward_without_an_entry_for_the_reset_is_read(self, minari: Any) -> None:
        from minari.data_collector import EpisodeBuffer

        demonstrations = make_demonstrations()
        dataset = demonstrations.select(n_episodes=1).to_minari("tiny/resets-v0")
        dense = np.array([1.0, 2.0], dtype=np.float32)
        buffer = EpisodeBuffer(
            observations=np.zeros((3, OBS_DIM), dtype=np.float32),
            actions=np.zeros((2, ACTION_DIM), dtype=np.float32),
            rewards=[0.0, 0.0],
            terminations=[False, False],
            truncations=[False, True],
            infos={"dense_reward": dense},
        )
        dataset.update_dataset_from_buffer([buffer])
        found = Demonstrations.from_minari(dataset).dense_rewards
        assert found is not None and demonstrations.dense_rewards is not None
        assert found.tolist() == [*demonstrations.dense_rewards[:3].tolist(), 1, 2]

    def test_dense_rewards_in_some_episodes_only_are_refused(self) -> None:
        dataset = make_demonstrations().to_minari("tiny/some-v0")
        dataset.update_dataset_from_buffer(
            [buffer_of(make_demonstrations(dense_rewards=None), dataset.observation_space, dataset.action_space)]
        )
        with pytest.raises(ValueError, match=r"tiny/some-v0.*'dense_rewards'.*3 of 4"):
            Demonstrations.from_minari(dataset)

    def test_an_unknown_environment_id_is_refused_or_given(self, minari: Any) -> None:
        demonstrations = make_demonstrations()
        space, action_space = spaces.Box(-9, 9, (OBS_DIM,)), spaces.Box(-1, 1, (ACTION_DIM,))
        episode = buffer_of(demonstrations, space, action_space)
        dataset = minari.create_dataset_from_buffers(
            "tiny/nameless-v0", [episode], observation_space=space, action_space=action_space
        )
        with pytest.raises(ValueError, match="'env_id'"):
            Demonstrations.from_minari(dataset)
        assert Demonstrations.from_minari(dataset, env_id="Named-v0").env_id == "Named-v0"

    def test_no_episodes_and_no_dataset_are_refused(self) -> None:
        dataset = make_demonstrations().to_minari("tiny/filtered-v0").filter_episodes(lambda episode: False)
        with pytest.raises(ValueError, match="'observations': expected at least one episode"):
            Demonstrations.from_minari(dataset)
        with pytest.raises(FileNotFoundError, match="tiny/absent-v0"):
            Demonstrations.from_minari("tiny/absent-v0")

    def test_an_id_stands_for_its_dataset_in_the_environments_order(self, tiny_reach: str) -> None:
        demonstrations = make_demonstrations()
        demonstrations.to_minari("tiny/by-id-v0")
        assert_equal(resolve("tiny/by-id-v0"), demonstrations)
        order = spaces.Dict([("goal", TinyReach.observation_space["goal"]), ("state", TinyReach.observation_space["state"])])
        assert np.array_equal(resolve("tiny/by-id-v0", order).observations, np.roll(demonstrations.observations, 1, axis=1))

    def test_an_id_that_is_not_on_this_machine_says_how_to_fetch_it(self) -> None:
        with pytest.raises(FileNotFoundError, match="minari download tiny/absent-v3"):
            resolve("tiny/absent-v3")

    def test_discrete_actions_are_refused(self, minari: Any) -> None:
        episode = buffer_of(make_demonstrations(), spaces.Box(-9, 9, (OBS_DIM,)), spaces.Box(-1, 1, (ACTION_DIM,)))
        dataset = minari.create_dataset_from_buffers(
            "tiny/discrete-v0",
            [dataclasses.replace(episode, actions=np.zeros(3, dtype=np.int64))],
            observation_space=spaces.Box(-9, 9, (OBS_DIM,)),
            action_space=spaces.Discrete(2),
        )
        with pytest.raises(ValueError, match="'actions': expected a Box"):
            Demonstrations.from_minari(dataset, env_id="Named-v0")

    def test_a_jump_within_an_episode_cannot_be_exported(self) -> None:
        next_observations = make_fields()["next_observations"]
        next_observations[5] += 1
        with pytest.raises(ValueError, match=r"'next_observations'.*transition 5"):
            make_demonstrations(next_observations=next_observations).to_minari("tiny/jump-v0")

    def test_demonstrations_that_do_not_fit_the_environment_are_not_exported(self, tiny_reach: str, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="'actions'"):
            make_demonstrations(actions=np.full((N, ACTION_DIM), 3.0)).to_minari("tiny/unfit-v0")
        assert not (tmp_path / "tiny").exists()


def test_a_minari_id_without_minari_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ImportError, match=r"sb3-actpc\[minari\]"):
        resolve("mujoco/hopper/expert-v0")


def test_a_file_whose_name_looks_like_a_minari_id_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_demonstrations().save("mine-v0")
    assert_equal(resolve("mine-v0"), make_demonstrations())


@pytest.mark.parametrize("folder", ["/home/someone/site-packages/sb3_actpc/data/", "C:\\lib\\sb3_actpc\\data\\"])
def test_the_packages_files_are_found_wherever_it_is_installed(folder: str) -> None:
    own = shipped_demonstrations("SparseReacher-v5")
    assert_equal(resolve(folder + own.name), Demonstrations.load(own))
    with pytest.raises(FileNotFoundError):
        resolve(folder.replace("data", "other") + own.name)


def test_an_unknown_task_has_nothing_shipped_and_near_ones_are_named() -> None:
    """A task of one's own that is registered is no slip of the pen."""
    with pytest.raises(
        FileNotFoundError, match=r"of SparseHoper-v5 are shipped \(did you mean 'SparseHopper-v5'\?\): .* list demos"
    ):
        shipped_demonstrations("SparseHoper-v5")
    gym.register("SparseHoper-v0", "gymnasium.envs.classic_control:PendulumEnv")
    with pytest.raises(FileNotFoundError, match="of SparseHoper-v0 are shipped: collect"):
        shipped_demonstrations("SparseHoper-v0")
    del gym.registry["SparseHoper-v0"]


def test_demonstrations_are_imported_without_what_is_heavy() -> None:
    program = "import sys; from sb3_actpc import Demonstrations; from sb3_actpc.demonstrations import Demonstrations as Same; "
    program += (
        "assert Same is Demonstrations; print(sorted({'torch', 'stable_baselines3', 'mujoco', 'h5py'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.strip() == "[]"


def test_metadata_is_readable_without_the_package(saved: Path) -> None:
    with np.load(saved, allow_pickle=False) as archive:
        assert json.loads(archive["metadata"].item()) == make_fields()["metadata"]
        assert json.loads(archive["env_id"].item()) == "TinyReach-v0"


def test_an_episode_of_ones_own_arrays() -> None:
    """n + 1 observations say what followed each step; nobody says that it ended by itself."""
    seen = np.arange(8.0).reshape(4, 2)
    one = {"observations": seen, "actions": np.array([0.1, 0.2, 0.3]), "rewards": np.array([0.0, 0.0, 1.0])}
    made = Demonstrations.from_episodes([one, one], "Mine-v0")
    assert (
        made.observations.tolist() == [*seen[:3].tolist()] * 2 and made.next_observations.tolist() == [*seen[1:].tolist()] * 2
    )
    assert made.actions.shape == (6, 1) and not made.terminations.any() and made.episode_starts.tolist() == [0, 3]
    ended = Demonstrations.from_episodes([{**one, "terminations": np.array([False, False, True])}], "Mine-v0")
    assert ended.terminations.tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"observations": np.zeros((3, 2))}, "must have 4 observations, found 3"),
        ({"rewards": None}, "'rewards': expected a column of every episode, found only actions, observations"),
        ({"actions": None}, "'actions': expected a column of every episode"),
        (
            {"termination": np.zeros(3)},
            r"'termination': expected one of observations, actions, .*, found a column of this name",
        ),
        ({"rewards": np.ones(2)}, "'rewards': expected 3 rows, as the episode has actions, found 2"),
        ({"terminations": np.zeros(4)}, "'terminations': expected 3 rows, as the episode has actions, found 4"),
        ({"observations": np.zeros((1, 2)), "actions": np.zeros((0, 1)), "rewards": np.ones(0)}, "found an episode of none"),
        ({"rewards": 1.0}, "'rewards': expected an array with a row for each step, found 1.0"),
        (
            {"observations": {"a": np.zeros((4, 2))}},
            r"'observations': .* found dictionaries: flatten them, as .*spaces.flatten",
        ),
        (
            {"observations": [{"a": np.zeros(2)}] * 4},
            r"'observations': .* found dictionaries: flatten them, as .*spaces.flatten",
        ),
        ({"infos": {"a": np.zeros(3)}}, "'infos': expected one of observations, .*, found a column of this name"),
        ({"rewards": np.ma.array(np.ones(3), mask=[0, 1, 0])}, "'rewards': .* found a masked array"),
        ({"observations": [[0.0, 1.0], [0.0]]}, "'observations': expected rows of one size"),
    ],
)
def test_columns_that_are_missing_or_do_not_fit_are_named(change: dict[str, Any], named: str) -> None:
    one = {"observations": np.zeros((4, 2)), "actions": np.zeros((3, 1)), "rewards": np.ones(3), **change}
    with pytest.raises(ValueError, match=named):
        Demonstrations.from_episodes([one], "Mine-v0")


def test_what_is_no_sequence_of_episodes_says_so() -> None:
    one: Any = {"observations": np.zeros((4, 2)), "actions": np.zeros((3, 1)), "rewards": np.ones(3)}
    for given, named in (
        (one, "found a dictionary: put it in a list"),
        ([[1.0]], "found a list"),
        ([], "found none"),
        (iter([]), "found none"),
    ):
        with pytest.raises(ValueError, match=named):
            Demonstrations.from_episodes(given, "Mine-v0")
    with pytest.raises(ValueError, match=r"'metadata': expected a dictionary, found \[1\]"):
        Demonstrations.from_episodes([one], "Mine-v0", metadata=[1])  # type: ignore[arg-type]


def test_what_is_no_file_is_not_printed_whole(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="found a dict: of arrays of your own make one with"):
        resolve({"observations": np.zeros((500, 3))})  # type: ignore[arg-type]
    np.savez(tmp_path / "mine.npz", observations=np.zeros((5, 3)))
    with pytest.raises(
        ValueError, match=r"an entry, as Demonstrations.save writes it .*from_episodes.*found only observations"
    ):
        resolve(tmp_path / "mine.npz")


class TestTimeLimits:
    """Episodes longer than the environment's are named."""

    def fit(self, n_steps: int, limit: int | None) -> None:
        rng = np.random.default_rng(0)
        columns = {"observations": rng.uniform(-1, 1, (n_steps + 1, 3)), "actions": rng.uniform(-1, 1, (n_steps, 1))}
        given = Demonstrations.from_episodes([{**columns, "rewards": np.ones(n_steps)}], "Pendulum-v1")
        env = DummyVecEnv([lambda: Monitor(gym.make("Pendulum-v1", max_episode_steps=limit))])
        fit_demonstrations(given, env, env.observation_space, env.action_space)

    @pytest.mark.parametrize(("n_steps", "limit"), [(400, 200), (201, None), (51, 50)])
    def test_longer_ones_are_named(self, n_steps: int, limit: int | None) -> None:
        with pytest.warns(UserWarning, match=f"up to {n_steps} steps, the environment's at most {limit or 200}"):
            self.fit(n_steps, limit)

    @pytest.mark.parametrize(("n_steps", "limit"), [(200, 200), (100, 200), (400, 400)])
    def test_others_are_not(self, n_steps: int, limit: int | None) -> None:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="demonstrated episodes have")
            self.fit(n_steps, limit)
