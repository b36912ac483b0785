"""Demonstrations: what is accepted, what is refused and by which name, and that files give back what was put in."""

from __future__ import annotations

import dataclasses
import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_actpc.demonstrations import Demonstrations, fit_demonstrations, resolve, shipped_demonstrations
from sb3_actpc.demonstrations.npz import FORMAT_VERSION
from sb3_actpc.utils.files import atomic_write
from tests.recordings import record, write_minari

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
        "metadata": {"command": "collect --seed 0", "seed": 0, "author": "Zoë — 李\0\n"},
    }


STORED_NAMES = sorted(
    {*make_fields(), "format_version", "next_observation_rows", "next_observation_indices"} - {"next_observations"}
)


def make_demonstrations(**changes: Any) -> Demonstrations:
    return Demonstrations(**{**make_fields(), **changes})


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

    def test_bounds_and_returns_are_of_each_episode(self) -> None:
        rewards = np.arange(N)
        demonstrations = make_demonstrations(rewards=rewards, dense_rewards=2 * rewards)
        assert (len(demonstrations), demonstrations.n_episodes) == (N, len(LENGTHS))
        assert demonstrations.episode_bounds.tolist() == [[0, 3], [3, 4], [4, 9]]
        assert demonstrations.episode_returns.tolist() == [0 + 1 + 2, 3, 4 + 5 + 6 + 7 + 8]
        assert demonstrations.dense_returns is not None and demonstrations.dense_returns.tolist() == [6, 6, 60]
        assert make_demonstrations(dense_rewards=None).dense_returns is None

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("observations", np.zeros((0, OBS_DIM))),
            ("observations", np.zeros((N, OBS_DIM, 1))),
            ("observations", np.full((N, OBS_DIM), "1")),
            ("observations", np.zeros((N, OBS_DIM), dtype=object)),
            ("observations", [[1.0], [1.0, 2.0]]),
            ("actions", np.zeros((N - 1, ACTION_DIM))),
            ("actions", np.zeros((N, 0))),
            ("next_observations", np.zeros((N, OBS_DIM + 1))),
            ("rewards", np.zeros((N, 1))),
            ("rewards", 0.0),
            ("dense_rewards", np.zeros(N - 1)),
            ("terminations", np.full(N, 0.5)),
            ("terminations", np.full(N, np.nan)),
            ("terminations", np.ones(N, dtype=bool)),
            ("episode_starts", []),
            ("episode_starts", [1, 3]),
            ("episode_starts", [0, 4, 4]),
            ("episode_starts", [0, N]),
            ("episode_starts", [0.5, 3.0]),
            ("env_id", ""),
            ("env_id", None),
            ("metadata", {"array": np.zeros(2)}),
            ("metadata", {"nan": float("nan")}),
            ("metadata", "text"),
        ],
    )
    def test_a_field_that_does_not_fit_is_refused_by_name(self, field: str, value: Any) -> None:
        with pytest.raises(ValueError, match=f"field '{field}': expected .*, found "):
            make_demonstrations(**{field: value})

    @pytest.mark.parametrize("field", ["observations", "actions", "next_observations", "rewards", "dense_rewards"])
    @pytest.mark.parametrize("value", [np.nan, -np.inf, 1e300])
    def test_values_that_float32_cannot_hold_are_refused_with_their_place(self, field: str, value: float) -> None:
        values = make_fields()[field].astype(np.float64)
        values[(2,) * values.ndim if values.ndim == 1 else (2, 1)] = value
        with pytest.raises(ValueError, match=rf"field '{field}'.*at index \(2,"):
            make_demonstrations(**{field: values})


class TestSelect:
    @pytest.mark.parametrize(
        ("limits", "bounds"),
        [
            ({"n_episodes": 2}, [[0, 3], [3, 4]]),
            ({"n_transitions": 6}, [[0, 3], [3, 4], [4, 6]]),
            ({"n_transitions": 4}, [[0, 3], [3, 4]]),
            ({"n_episodes": 2, "n_transitions": 2}, [[0, 2]]),
            ({}, [[0, 3], [3, 4], [4, 9]]),
        ],
    )
    def test_first_episodes_and_transitions(self, limits: dict[str, int], bounds: list[list[int]]) -> None:
        whole, selection = make_demonstrations(), make_demonstrations().select(**limits)
        assert selection.episode_bounds.tolist() == bounds
        end = bounds[-1][1]
        for name in ("next_observations", "terminations", "dense_rewards"):
            assert np.array_equal(getattr(selection, name), getattr(whole, name)[:end])
        assert selection.metadata == whole.metadata

    @pytest.mark.parametrize("count", [0, 1000, 1.5, True, "2"])
    @pytest.mark.parametrize("name", ["n_episodes", "n_transitions"])
    def test_more_than_there_is_or_no_whole_number_is_refused(self, name: str, count: Any) -> None:
        with pytest.raises(ValueError, match=f"{name} must be a whole number from 1 to .*found"):
            make_demonstrations().select(**{name: count})


class TestCheck:
    observation_space = spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float64)
    action_space = spaces.Box(-1, 1, (ACTION_DIM,), np.float32)

    @pytest.mark.parametrize("env_id", [None, "TinyReach-v0", "TinyReach-v5", "TinyReach", "some.module:TinyReach-v1"])
    def test_fitting_spaces_and_other_versions_pass(self, env_id: str | None) -> None:
        make_demonstrations().check(self.observation_space, self.action_space, env_id)
        part = spaces.Box(-1, 1, (2,))
        make_demonstrations().check(spaces.Dict(goal=part, state=part), self.action_space, env_id)

    @pytest.mark.parametrize("env_id", ["TinyPush-v0", "TinyReach2-v0", "TinyReach-v0-extra", ""])
    def test_another_environment_is_refused(self, env_id: str) -> None:
        with pytest.raises(ValueError, match=f"'env_id': expected '{env_id}'.* found 'TinyReach-v0'"):
            make_demonstrations().check(self.observation_space, self.action_space, env_id)

    @pytest.mark.parametrize(
        ("spaces_", "named"),
        [
            ((spaces.Box(-1, 1, (5,)), action_space), "'observations': expected 5 values a row, found 4"),
            ((observation_space, spaces.Box(-1, 1, (3,))), "'actions': expected 3 values a row, found 2"),
            ((observation_space, spaces.Discrete(2)), "'actions': expected a Box"),
            ((spaces.Discrete(4), action_space), "need Box observations or a Dict of Boxes"),
        ],
    )
    def test_other_spaces_are_refused(self, spaces_: Any, named: str) -> None:
        with pytest.raises(ValueError, match=named):
            make_demonstrations().check(*spaces_)

    @pytest.mark.parametrize("side", [-1, 1])
    def test_actions_may_leave_their_bounds_by_a_rounding_only(self, side: int) -> None:
        actions = make_fields()["actions"]
        actions[4, 1] = side * (1 + 5e-5)
        make_demonstrations(actions=actions).check(self.observation_space, self.action_space)
        actions[4, 1] = side * (1 + 2e-4)
        with pytest.raises(ValueError, match=r"'actions': expected values in \[-1.0, 1.0\] in column 1.*transition 4"):
            make_demonstrations(actions=actions).check(self.observation_space, self.action_space)


def with_jumps() -> Demonstrations:
    """Next observations that are not the following ones, one of them by the sign of its zero alone."""
    fields = make_fields()
    fields["observations"][1], fields["next_observations"][0] = 0.0, -0.0  # equal numbers, other bits
    fields["next_observations"][5] += 1.0
    return Demonstrations(**fields)


class TestFile:
    @pytest.mark.parametrize(
        "demonstrations",
        [
            make_demonstrations(),
            make_demonstrations(dense_rewards=None, metadata={}),
            Demonstrations(**make_fields(lengths=(1,))),
            with_jumps(),
        ],
    )
    def test_round_trip_is_equal_bit_for_bit(self, demonstrations: Demonstrations, tmp_path: Path) -> None:
        demonstrations.save(tmp_path / "no_suffix")
        assert_equal(Demonstrations.load(tmp_path / "no_suffix"), demonstrations)
        assert os.listdir(tmp_path) == ["no_suffix"]

    def test_saving_again_gives_the_same_bytes_and_next_observations_are_not_stored_twice(self, saved: Path) -> None:
        first = saved.read_bytes()
        Demonstrations.load(saved).save(saved)
        assert saved.read_bytes() == first
        with np.load(saved) as archive:
            assert archive["next_observation_indices"].tolist() == [2, 3, 8]

    def test_missing_files_and_folders_are_named(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError) as caught:
            Demonstrations.load(tmp_path / "nowhere.npz")
        assert f"no demonstrations file at {tmp_path / 'nowhere.npz'} (ids of Minari end" in str(caught.value)
        with pytest.raises(ValueError, match=r"expected a demonstrations .npz file.* directory.*from_trajectories"):
            Demonstrations.load(tmp_path)
        for content in (b"", b"PK\x03\x04", b"\x93NUMPY\x01\x00v\x00"):
            (tmp_path / "other.npz").write_bytes(content)
            with pytest.raises(ValueError, match=r"other\.npz: expected a demonstrations \.npz file"):
                Demonstrations.load(tmp_path / "other.npz")

    def test_a_file_cut_short_or_with_a_flipped_bit_is_refused(self, saved: Path) -> None:
        content, expected = saved.read_bytes(), make_demonstrations()
        for length in range(0, len(content), 29):
            saved.write_bytes(content[:length])
            with pytest.raises(ValueError, match=r"demonstrations\.npz: "):
                Demonstrations.load(saved)
        rng = np.random.default_rng(0)
        refused = 0
        for position in range(0, len(content), 7):
            damaged = bytearray(content)
            damaged[position] ^= 1 << int(rng.integers(8))
            saved.write_bytes(bytes(damaged))
            try:
                assert_equal(Demonstrations.load(saved), expected)
            except ValueError as error:
                assert "demonstrations.npz: " in str(error)
                refused += 1
        assert refused > 0

    @pytest.mark.parametrize("name", STORED_NAMES)
    def test_missing_entries_and_pickles_are_refused_by_name_and_never_run(
        self, saved: Path, tmp_path: Path, name: str
    ) -> None:
        content, marker = saved.read_bytes(), tmp_path / "was_run"
        with pytest.raises(ValueError, match=rf"demonstrations\.npz: demonstrations field '{name}': expected an entry"):
            Demonstrations.load(rewrite(saved, **{name: None}))
        saved.write_bytes(content)
        with pytest.raises(ValueError, match=rf"demonstrations\.npz: demonstrations field '{name}'"):
            Demonstrations.load(rewrite(saved, **{name: np.array([Payload(str(marker))], dtype=object)}))
        assert not marker.exists()

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("observations", np.full((N, OBS_DIM), np.nan, dtype=np.float32)),
            ("actions", np.full((N, ACTION_DIM), "1")),
            ("rewards", np.zeros(N + 1)),
            ("terminations", np.full(N, "yes")),
            ("episode_starts", np.array([], dtype=np.int64)),
            ("next_observation_indices", np.array([2, 3, N])),
            ("next_observation_indices", np.array([2.0, 3.0, 8.0])),
            ("env_id", np.array(3)),
            ("env_id", np.array("{broken")),
            ("env_id", np.array(['"A-v0"', '"B-v0"'])),
            ("metadata", np.array("[1]")),
            ("format_version", np.array(FORMAT_VERSION + 1)),
            ("format_version", np.array("1")),
        ],
    )
    def test_a_wrong_entry_is_refused_by_file_and_name(self, saved: Path, name: str, value: np.ndarray) -> None:
        with pytest.raises(ValueError, match=rf"demonstrations\.npz: demonstrations field '{name}': expected .*, found "):
            Demonstrations.load(rewrite(saved, **{name: value}))


class Payload:
    """Unpickling this makes a folder, which a reader that never unpickles does not."""

    def __init__(self, marker: str) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return os.mkdir, (self.marker,)


class TestAtomicWrite:
    def test_the_old_content_is_readable_until_the_block_ends(self, tmp_path: Path) -> None:
        path = tmp_path / "new" / "folder" / "file.txt"
        for text in ("old ü\n", "new ü\n"):
            with atomic_write(path, "w") as file:
                file.write(text)
                assert text == "old ü\n" or path.read_text() == "old ü\n"
            path.chmod(0o640)
        assert path.read_bytes() == "new ü\n".encode() and path.stat().st_mode & 0o777 == 0o640
        assert os.listdir(path.parent) == ["file.txt"]

    @pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
    def test_an_error_leaves_the_old_file_and_nothing_else(self, saved: Path, error: type[BaseException]) -> None:
        before = saved.read_bytes()
        for path in (saved, saved.with_name("new.npz")):
            with pytest.raises(error), atomic_write(path) as file:
                file.write(b"half")
                raise error
        assert saved.read_bytes() == before
        assert os.listdir(saved.parent) == [saved.name]

    def test_a_link_is_followed_and_a_folder_is_not_overwritten(self, tmp_path: Path) -> None:
        (tmp_path / "target.bin").write_bytes(b"old")
        (tmp_path / "link.bin").symlink_to("target.bin")
        with atomic_write(tmp_path / "link.bin") as file:
            file.write(b"new")
        assert (tmp_path / "link.bin").is_symlink()
        assert (tmp_path / "target.bin").read_bytes() == b"new"
        with pytest.raises(IsADirectoryError), atomic_write(tmp_path):
            pass


class TinyReach(gym.Env[Any, Any]):
    """Spaces only: the state before the goal, an order that is not alphabetical."""

    observation_space = spaces.Dict(
        [("state", spaces.Box(-np.inf, np.inf, (3,), np.float64)), ("goal", spaces.Box(-np.inf, np.inf, (1, 1), np.float64))]
    )
    action_space = spaces.Box(-1, 1, (1, ACTION_DIM), np.float32)


@pytest.fixture
def tiny_reach() -> Iterator[gym.Env[Any, Any]]:
    env_id = "TinyReach-v0"
    gym.register(env_id, entry_point=f"{__name__}:TinyReach", max_episode_steps=5)
    with gym.make(env_id, disable_env_checker=True) as env:
        yield env
    del gym.registry[env_id]


@pytest.mark.filterwarnings("ignore:.*is set to None:UserWarning", "ignore:env_spec is None:UserWarning")
class TestMinari:
    @pytest.fixture(autouse=True)
    def minari(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
        pytest.importorskip("h5py")
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
        return pytest.importorskip("minari")

    @pytest.mark.parametrize("dense", [True, False])
    def test_a_dataset_is_read_in_the_environments_order(self, dense: bool, tiny_reach: gym.Env[Any, Any]) -> None:
        """The Dict's keys, sorted by Minari, and the ends: a time limit cuts the second episode."""
        demonstrations = make_demonstrations(metadata={}, **({} if dense else {"dense_rewards": None}))
        dataset = write_minari(demonstrations, "tiny/dict-v0", tiny_reach)
        order = tiny_reach.observation_space
        assert_equal(Demonstrations.from_minari(dataset, observation_space=order), demonstrations)
        assert_equal(resolve("tiny/dict-v0", order), demonstrations)
        goal_first = np.roll(demonstrations.observations, 1, axis=1)
        assert np.array_equal(resolve("tiny/dict-v0").observations, goal_first)

    def test_an_environment_without_an_id_is_named(self) -> None:
        dataset = write_minari(make_demonstrations(), "tiny/nameless-v0", TinyReach())
        with pytest.raises(ValueError, match="'env_id'"):
            Demonstrations.from_minari(dataset)
        assert Demonstrations.from_minari(dataset, env_id="Named-v0").env_id == "Named-v0"

    def test_no_episodes_and_no_dataset_are_refused(self, tiny_reach: gym.Env[Any, Any]) -> None:
        dataset = write_minari(make_demonstrations(), "tiny/filtered-v0", tiny_reach).filter_episodes(lambda episode: False)
        with pytest.raises(ValueError, match="expected at least one episode"):
            Demonstrations.from_minari(dataset)
        with pytest.raises(FileNotFoundError, match="minari download tiny/absent-v3"):
            resolve("tiny/absent-v3")

    @pytest.mark.parametrize(
        ("kind", "action_space", "named"),
        [
            (np.uint8, spaces.Box(-1, 1, (1,)), "'observations.*': expected"),  # which Minari stores as JPEG
            (np.float32, spaces.Discrete(2), "'actions': expected a Box"),
        ],
    )
    def test_what_cannot_be_read_is_refused(
        self, kind: type, action_space: spaces.Space[Any], named: str, minari: Any
    ) -> None:
        from minari.data_collector import EpisodeBuffer

        space = spaces.Box(0, 255, (OBS_DIM,), kind)
        ends = {"rewards": [0.0] * 3, "terminations": [False] * 3, "truncations": [False] * 3}
        actions = np.zeros((3, *action_space.shape), action_space.dtype)
        seen = np.random.default_rng(0).integers(0, 255, (4, OBS_DIM)).astype(kind)
        made = minari.create_dataset_from_buffers(
            "tiny/other-v0",
            [EpisodeBuffer(observations=seen, actions=actions, **ends)],
            observation_space=space,
            action_space=action_space,
        )
        with pytest.raises(ValueError, match=named):
            Demonstrations.from_minari(made, env_id="Named-v0").check(space, action_space)


def test_a_minari_id_without_minari_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ImportError, match=r"sb3-actpc\[minari\]"):
        resolve("mujoco/hopper/expert-v0")


def test_a_path_a_text_and_demonstrations_are_resolved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also a file whose name looks like a Minari id."""
    monkeypatch.chdir(tmp_path)
    demonstrations = make_demonstrations()
    assert resolve(demonstrations) is demonstrations
    demonstrations.save("mine-v0")
    for source in ("mine-v0", tmp_path / "mine-v0"):
        assert_equal(resolve(source), demonstrations)
    for wrong in (None, 3, {"observations": np.zeros((500, 3))}):
        with pytest.raises(ValueError, match=r"Minari id or a Demonstrations object, found a \w+: .*from_episodes"):
            resolve(wrong)  # type: ignore[arg-type]


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


def test_an_episode_of_ones_own_arrays() -> None:
    """n + 1 observations say what followed each step; nobody says that it ended by itself."""
    seen = np.arange(8.0).reshape(4, 2)
    one = {"observations": seen, "actions": np.array([0.1, 0.2, 0.3]), "rewards": np.array([0.0, 0.0, 1.0])}
    made = Demonstrations.from_episodes([one, one], "Mine-v0")
    assert made.observations.tolist() == seen[:3].tolist() * 2 and made.next_observations.tolist() == seen[1:].tolist() * 2
    assert made.actions.shape == (6, 1) and not made.terminations.any() and made.episode_starts.tolist() == [0, 3]
    ended = Demonstrations.from_episodes([{**one, "terminations": np.array([False, False, True])}], "Mine-v0")
    assert ended.terminations.tolist() == [False, False, True]
    assert_equal(Demonstrations.from_episodes([*made.episodes][:1] * 2, "Mine-v0"), made)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"observations": np.zeros((3, 2))}, "'observations': expected .* an observation more than actions, found 3 and 3"),
        ({"rewards": None}, "'rewards': expected a column of this name, which is needed, found observations, actions"),
        ({"termination": np.zeros(3)}, "'termination': expected some of the columns observations, actions"),
        ({"rewards": np.ones(2)}, "'rewards': expected 3 rows, as the episode has actions, found 2"),
        ({"terminations": np.zeros(4)}, "'terminations': expected 3 rows, as the episode has actions, found 4"),
        (
            {"observations": np.zeros((1, 2)), "actions": np.zeros((0, 1)), "rewards": np.ones(0)},
            "expected a step, .* found 1 and 0",
        ),
        ({"rewards": 1.0}, "'rewards': expected numbers, a row for each step"),
        ({"observations": {"a": np.zeros((4, 2))}}, r"'observations': .*spaces.flatten.* found a dict"),
        ({"observations": [{"a": np.zeros(2)}] * 4}, r"'observations': .*spaces.flatten.* found a list"),
        ({"observations": [[0.0, 1.0], [0.0]]}, "'observations': expected rows of one size"),
        ({"actions": np.ones((3, 1), np.int64)}, "'actions': expected floats, .* found whole numbers .* Discrete"),
    ],
)
def test_columns_that_are_missing_or_do_not_fit_are_named(change: dict[str, Any], named: str) -> None:
    one = {"observations": np.zeros((4, 2)), "actions": np.zeros((3, 1)), "rewards": np.ones(3), **change}
    with pytest.raises(ValueError, match=named):
        Demonstrations.from_episodes([one], "Mine-v0")


def test_what_is_no_sequence_of_like_episodes_says_so() -> None:
    one = {"observations": np.zeros((4, 2)), "actions": np.zeros((3, 1)), "rewards": np.ones(3)}
    wider: Any = {**one, "observations": np.zeros((4, 3))}
    for given, named in (
        (one, "put it in a list"),
        ([[1.0]], "found a list"),
        ([], "found none"),
        ([one, wider], "of one size"),
    ):
        with pytest.raises(ValueError, match=named):
            Demonstrations.from_episodes(given, "Mine-v0")  # type: ignore[arg-type]


def test_episodes_that_no_time_limit_ended_need_their_terminations() -> None:
    """Without the column the critic would bootstrap beyond the end."""
    one = {"observations": np.zeros((4, 3)), "actions": np.zeros((3, 1)), "rewards": np.ones(3)}
    with pytest.warns(UserWarning, match=r"one has 3 steps and Pendulum-v1 a limit of 200: give the column"):
        Demonstrations.from_episodes([one], "Pendulum-v1")
    whole = {"observations": np.zeros((201, 3)), "actions": np.zeros((200, 1)), "rewards": np.ones(200)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = Demonstrations.from_episodes([{**one, "terminations": np.zeros(3, dtype=bool)}, whole], "Pendulum-v1")
        assert_equal(Demonstrations.from_episodes(made.episodes, "Pendulum-v1"), made)


def test_observations_in_other_units_are_warned_of() -> None:
    shown = record("Pendulum-v1")
    env = DummyVecEnv([lambda: gym.make("Pendulum-v1")])
    spaces_ = env.observation_space, env.action_space
    with pytest.warns(
        UserWarning, match=r"of the demonstrated observations lie outside the environment's bounds, .* of \[-1, 1\]"
    ):
        fit_demonstrations(dataclasses.replace(shown, observations=10.0 * shown.observations), env, *spaces_)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_demonstrations(shown, env, *spaces_)
