"""Demonstrations of the robosuite tasks: robomimic's and robosuite's files, scripted demonstrators, the commands."""

import functools
import http.server
import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest

from sb3_actpc.cli import main
from sb3_actpc.demonstrations import ScriptedDemonstrator, collect_scripted, read_hdf5, robomimic
from sb3_actpc.demonstrations.dataset import Demonstrations, shipped_demonstrations
from sb3_actpc.demonstrations.scripted import turn_to_point_down, yaw_of
from sb3_actpc.envs import ROBOSUITE_IDS
from sb3_actpc.envs.robosuite_layouts import ROBOSUITE_TASKS, RobosuiteTask
from tests.demonstrations.made_up import made_up, write_robomimic

LIFT, CAN = ROBOSUITE_IDS


@pytest.fixture
def lift_file(tmp_path: Path) -> Path:
    write_robomimic(made_up(LIFT), tmp_path / "lift.hdf5")
    return tmp_path / "lift.hdf5"


def assert_equal(first: Demonstrations, second: Demonstrations, atol: float = 0.0) -> None:
    for name in ("observations", "actions", "next_observations", "rewards", "terminations", "episode_starts"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), atol=atol, rtol=0, err_msg=name)


def test_the_can_is_seen_from_the_gripper() -> None:
    """The gripper at (1, 0, 0), turned a quarter about z: what lies ahead of it along y is at its x."""
    quarter = np.array([[0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]])
    state = ROBOSUITE_TASKS[CAN].object_states(np.array([[1.0, 2.0, 0.5]]), quarter, np.array([[1.0, 0.0, 0.0]]), quarter)
    np.testing.assert_allclose(state[0, :7], [2.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(state[0, 7:10], [1.0, 2.0, 0.5])


def test_the_gripper_turns_the_shortest_way() -> None:
    """Turned by half about x it points down; a quaternion and its negative are the same orientation."""
    pointing_down = np.array([np.cos(0.15), np.sin(0.15), 0.0, 0.0])  # then by 0.3 about the vertical
    for quat in (pointing_down, -pointing_down):
        np.testing.assert_allclose(turn_to_point_down(quat, 1.0), [0.0, 0.0, 0.7], atol=1e-12)
        assert yaw_of(quat) == pytest.approx(0.3)


# ------------------------------------------------------------------ robomimic's files


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
@pytest.mark.parametrize("obs", ["paper", "robomimic"])
def test_robomimics_files_are_read(env_id: str, obs: str, tmp_path: Path) -> None:
    """In the order of the demonstrations' numbers: demo_2 before demo_10."""
    original = made_up(env_id, obs=obs, lengths=tuple(range(2, 14)))
    write_robomimic(original, tmp_path / "a.hdf5")
    assert_equal(read_hdf5(tmp_path / "a.hdf5", env_id, obs), original, atol=2e-6)


@pytest.mark.parametrize(
    ("listed", "read"),
    [
        (np.array([b"demo_0  ", b"demo_2\0\0", b"        ", b"demo_2"], dtype="S8"), ["demo_0", "demo_2"]),
        (np.array(["demo_1", "demo_1 "], dtype=h5py.string_dtype()), ["demo_1"]),
    ],
)
def test_a_mask_lists_every_demonstration_once_whatever_its_padding(
    listed: np.ndarray, read: list[str], lift_file: Path
) -> None:
    edit(lift_file, lambda file: file.create_dataset("mask/mine", data=listed))
    found = read_hdf5(lift_file, LIFT, filter_key="mine")
    assert found.metadata["demos"] == read and found.n_episodes == len(read)
    with pytest.raises(ValueError, match=r"no mask 'okay': choose one of 20_percent, better, mine, worse"):
        read_hdf5(lift_file, LIFT, filter_key="okay")


def edit(path: Path, change: Callable[[h5py.File], object]) -> None:
    with h5py.File(path, "r+") as file:
        change(file)


def replace(file: h5py.File, key: str, values: np.ndarray) -> None:
    del file[key]
    file[key] = values


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_objects_recorded_by_robosuite_1_4_become_those_of_1_5(env_id: str, tmp_path: Path) -> None:
    original, path = made_up(env_id), tmp_path / "old.hdf5"
    write_robomimic(original, path)

    def as_1_4(file: h5py.File) -> None:
        for name in file["data"]:
            for kind in ("obs", "next_obs"):
                states = file[f"data/{name}/{kind}/object"][()]
                moved = [states[:, :7], -states[:, 7:]] if env_id == LIFT else [states[:, 7:], states[:, :7]]
                replace(file, f"data/{name}/{kind}/object", np.concatenate(moved, axis=1))

    edit(path, as_1_4)
    assert_equal(read_hdf5(path, env_id), original, atol=2e-6)


def test_the_lag_of_robosuite_1_5_is_taken_out(tmp_path: Path) -> None:
    """It gives the can's pose in the gripper's frame one step late."""
    original, path = made_up(CAN, lengths=(9,)), tmp_path / "lag.hdf5"
    write_robomimic(original, path)

    def lag(file: h5py.File) -> None:
        states = file["data/demo_0/obs/object"][()]
        states[:, 2] += 0.003
        states[0, :7] = 0.0
        replace(file, "data/demo_0/obs/object", states)

    edit(path, lag)
    assert_equal(read_hdf5(path, CAN), original, atol=2e-6)


def test_missing_rewards_are_computed_and_dense_ones_kept_apart(lift_file: Path) -> None:
    original = made_up(LIFT)
    edit(lift_file, lambda file: [file[f"data/{name}"].pop("rewards") for name in file["data"]])
    read = read_hdf5(lift_file, LIFT)
    assert read.rewards.tolist() == original.rewards.tolist() and read.dense_rewards is None
    dense = np.linspace(0.1, 0.9, 5)
    for index, n in enumerate((4, 3, 5)):
        edit(lift_file, lambda file, where=f"data/demo_{index}/rewards", n=n: file.create_dataset(where, data=dense[:n]))  # type: ignore[misc]
    read = read_hdf5(lift_file, LIFT)
    assert read.rewards.tolist() == original.rewards.tolist() and read.dense_rewards is not None
    np.testing.assert_allclose(read.dense_rewards[4:7], dense[:3])


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_observed_success_wins_over_rewards_that_are_zero_throughout(env_id: str, tmp_path: Path) -> None:
    original = made_up(env_id)
    write_robomimic(original, tmp_path / "zero.hdf5")
    edit(tmp_path / "zero.hdf5", lambda file: replace(file, "data/demo_2/rewards", np.zeros(5)))
    read = read_hdf5(tmp_path / "zero.hdf5", env_id)
    assert read.rewards.tolist() == original.rewards.tolist()
    assert read.terminations.tolist() == original.terminations.tolist()


def test_an_episode_ends_at_its_first_success(lift_file: Path) -> None:
    edit(lift_file, lambda file: replace(file, "data/demo_2/rewards", np.array([0.0, 1.0, 1.0, 0.0, 1.0])))
    read = read_hdf5(lift_file, LIFT)
    assert read.episode_bounds[2].tolist() == [7, 9]
    assert read.terminations.tolist() == [False] * 3 + [True] + [False] * 2 + [True] + [False, True]


def test_without_next_observations_the_last_one_follows_itself(lift_file: Path) -> None:
    edit(lift_file, lambda file: [file[f"data/{name}"].pop("next_obs") for name in file["data"]])
    original, read = made_up(LIFT), read_hdf5(lift_file, LIFT)
    np.testing.assert_allclose(read.next_observations[:3], original.next_observations[:3], atol=2e-6)
    np.testing.assert_allclose(read.next_observations[3], original.observations[3], atol=2e-6)


def with_settings(**changes: Any) -> Callable[[h5py.File], object]:
    """Other keywords of robosuite."""

    def change(file: h5py.File) -> None:
        arguments = json.loads(file["data"].attrs["env_args"])
        arguments["env_kwargs"].update(changes)
        file["data"].attrs["env_args"] = json.dumps(arguments)

    return change


ABSOLUTE = {"type": "OSC_POSE", "control_delta": False}
BAD_FILES: dict[str, tuple[Callable[[h5py.File], object], str]] = {
    "no env_args": (lambda f: f["data"].attrs.pop("env_args"), "expected a whole HDF5 file of robomimic or robosuite"),
    "env_args": (
        lambda f: f["data"].attrs.__setitem__("env_args", "{"),
        "expected a whole HDF5 file of robomimic or robosuite",
    ),
    "robot": (with_settings(robots=["Sawyer"]), r"expected demonstrations with robots = 'Panda', found 'Sawyer'"),
    "controller": (with_settings(controller_configs={"type": "JOINT_VELOCITY"}), "'OSC_POSE', found 'JOINT_VELOCITY'"),
    "absolute poses": (with_settings(controller_configs=ABSOLUTE), "input_type = 'delta', found 'absolute'"),
    "no data": (lambda f: f.pop("data"), "expected a whole HDF5 file of robomimic or robosuite"),
    "no demos": (lambda f: [f["data"].pop(name) for name in list(f["data"])], r"expected demonstrations data/demo_0"),
    "actions missing": (lambda f: f["data/demo_1"].pop("actions"), r"demo_1/actions is missing, only dones"),
    "action size": (lambda f: replace(f, "data/demo_1/actions", np.zeros((3, 6))), r"demo_1/actions .*\(N, 7\).*\(3, 6\)"),
    "action range": (lambda f: replace(f, "data/demo_1/actions", np.full((3, 7), 2.0)), r"'actions': expected values in \[-1"),
    "no rows": (lambda f: replace(f, "data/demo_1/actions", np.zeros((0, 7))), r"demo_1/actions must hold numbers of shape"),
    "obs missing": (lambda f: f["data/demo_1"].pop("obs"), r"demo_1/obs/robot0_joint_pos_cos is missing"),
    "length": (lambda f: replace(f, "data/demo_2/obs/object", np.zeros((4, 10))), r"demo_2/obs/object .*\(5, 10\).*\(4, 10\)"),
    "nan": (
        lambda f: f["data/demo_1/obs/robot0_joint_vel"].write_direct(np.full((3, 7), np.nan)),
        "'observations': expected finite float32 values, found nan at index",
    ),
    "text": (lambda f: replace(f, "data/demo_0/rewards", np.array([b"x"] * 4)), r"demo_0/rewards must hold numbers"),
    "object": (
        lambda f: replace(f, "data/demo_0/obs/object", np.ones((4, 10))),
        r"demo_0/obs/object must hold pos, quat, to_eef_pos, .*: the distances differ",
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_named_with_demonstration_and_key(name: str, lift_file: Path) -> None:
    change, message = BAD_FILES[name]
    edit(lift_file, change)
    with pytest.raises(ValueError, match=message) as caught:
        read_hdf5(lift_file, LIFT)
    assert str(lift_file) in str(caught.value)


def test_a_file_cut_short_anywhere_is_refused(lift_file: Path) -> None:
    content = lift_file.read_bytes()
    for size in (0, 1, 100, len(content) // 2, len(content) - 1000):
        lift_file.write_bytes(content[:size])
        with pytest.raises(ValueError, match=rf"{lift_file}"):
            read_hdf5(lift_file, LIFT)


def test_another_task_and_a_missing_file_are_refused(lift_file: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="env_name = 'PickPlaceCan', found 'Lift'"):
        read_hdf5(lift_file, CAN)
    with pytest.raises(ValueError, match="is not a robosuite task"):
        read_hdf5(lift_file, "SparseHopper-v5")
    with pytest.raises(FileNotFoundError, match="no demonstrations file"):
        read_hdf5(tmp_path / "none.hdf5", LIFT)


# ------------------------------------------------------------------ commands


def test_convert_writes_npz_and_overwrites_nothing(
    lift_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["demos", "convert", "lift.hdf5", "--env", f"sb3_actpc.envs:{LIFT}"]
    assert main(command) == 0
    read = Demonstrations.load("lift.npz")
    assert_equal(read, made_up(LIFT), atol=2e-6)
    assert read.env_id == LIFT
    Path("named.npz").write_bytes(Path("lift.hdf5").read_bytes())
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert main(["demos", "convert", "named.npz", "--env", LIFT, "--output", "named.npz"]) == 2
    assert "--output named.npz is the file that is read" in capsys.readouterr().err
    for options, named in (
        ([], "lift.npz is there already: give another --output"),
        (["--output", "lift.hdf5"], "--output lift.hdf5 must end in .npz"),
    ):
        assert main([*command, *options]) == 2
        assert named in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert main([*command, "--filter-key", "better", "--output", "better.npz"]) == 0
    assert Demonstrations.load("better.npz").metadata["demos"] == ["demo_0", "demo_2"]


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """A web server on this machine, and the folder it serves."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

        def do_GET(self) -> None:
            if "half" not in self.path:
                return super().do_GET()
            self.send_response(200)  # and the connection breaks
            self.send_header("Content-Length", "1000")
            self.end_headers()
            self.wfile.write(b"\x89HDF")

    folder = tmp_path / "www"
    folder.mkdir()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}", folder
        running.shutdown()
        thread.join()


def test_download_fetches_checks_and_converts(
    server: tuple[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of half a download nothing is left, so that the next try fetches the file."""
    url, folder = server
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(robomimic, "REPOSITORY", url)
    published = folder / "v1.5/can/mh/low_dim_v15.hdf5"
    published.parent.mkdir(parents=True)
    write_robomimic(made_up(CAN), published)
    write_robomimic(made_up(LIFT), folder / "lift.hdf5")
    command = ["demos", "download", "--env", CAN]
    for address, message in (
        (f"{url}/lift.hdf5", "env_name = 'PickPlaceCan'"),
        (f"{url}/nothing.hdf5", "could not fetch"),
        (f"{url}/half.hdf5", "could not fetch"),
        ("http://127.0.0.1:9/x.hdf5", "demos convert"),  # as without a network
    ):
        assert main([*command, "--url", address, "--output", "failed/can.npz"]) == 2
        error = capsys.readouterr().err.strip()
        assert message in error and len(error.splitlines()) == 1
        found = [path.name for path in Path("failed").iterdir()]
        assert found == (["can.hdf5"] if address.endswith("lift.hdf5") else [])
        Path("failed/can.hdf5").unlink(missing_ok=True)
    assert main(command) == 0
    assert_equal(Demonstrations.load("sparse_pickplacecan_mh.npz"), made_up(CAN), atol=2e-6)


def test_a_bad_file_that_was_there_already_is_kept_and_named(lift_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["demos", "download", "--env", LIFT, "--output"]
    assert main([*command, str(lift_file)]) == 2
    assert "must end in .npz" in capsys.readouterr().err
    lift_file.write_bytes(lift_file.read_bytes()[:1000])
    assert main([*command, str(lift_file.with_suffix(".npz"))]) == 2
    error = capsys.readouterr().err
    assert "expected a whole HDF5 file" in error and "delete it" in error
    assert lift_file.stat().st_size == 1000


# ------------------------------------------------------------------ with the simulator


@pytest.fixture(scope="module")
def with_robosuite() -> None:
    pytest.importorskip("robosuite", reason="robosuite is an extra")


@pytest.mark.usefixtures("with_robosuite")
@pytest.mark.parametrize(("env_id", "obs"), [(LIFT, "paper"), (CAN, "robomimic")])
def test_a_sure_demonstrator_succeeds(env_id: str, obs: str) -> None:
    """More episodes: see docs/tasks.md; here a few starts."""
    recorded = collect_scripted(env_id, 1.0, n_episodes=2, seed=50, max_tries=2, obs=obs)
    assert recorded.episode_returns.tolist() == [1.0, 1.0]
    assert recorded.terminations.sum() == 2
    with gym.make(env_id, obs=obs) as env:
        recorded.check(env.observation_space, env.action_space, env_id)


@pytest.mark.usefixtures("with_robosuite")
def test_a_recording_can_be_repeated_and_played_again() -> None:
    first, second = (collect_scripted(LIFT, 0.3, n_episodes=2, seed=5) for _ in range(2))
    assert_equal(first, second)
    env = gym.make(LIFT)
    observation, _ = env.reset(seed=5)
    for row in range(int(first.episode_bounds[0, 1])):
        np.testing.assert_array_equal(observation, first.observations[row])
        observation, reward, *_ = env.step(first.actions[row])
        assert reward == first.rewards[row]
    env.close()


@pytest.mark.usefixtures("with_robosuite")
def test_a_mixed_set_has_six_demonstrators_that_take_turns(tmp_path: Path) -> None:
    output = tmp_path / "mixed.npz"
    assert main(["demos", "collect", "--env", LIFT, "--mixed", "--episodes", "7", "--output", str(output)]) == 0
    mixed = Demonstrations.load(output)
    assert mixed.metadata["command"] == f"sb3-actpc demos collect --env {LIFT} --mixed --episodes 7 --seed 0"
    lengths = np.diff(mixed.episode_bounds, axis=1).ravel()
    assert len(lengths) == 7 and lengths[[0, 6]].min() > 1.5 * lengths[1:6].max(), "the clumsiest, once more after the sixth"


@pytest.mark.parametrize("proficiency", [-0.1, 1.1, float("nan"), True])
def test_a_wrong_proficiency_is_refused(proficiency: float) -> None:
    with pytest.raises(ValueError, match="must be a number from 0"):
        ScriptedDemonstrator(LIFT, proficiency=proficiency)


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_successful_episodes_are_shipped(env_id: str) -> None:
    shipped = Demonstrations.load(shipped_demonstrations(env_id))
    assert shipped.env_id == env_id
    assert shipped.n_episodes == {"SparseLift-v0": 50, "SparsePickPlaceCan-v0": 25}[env_id]
    assert (shipped.episode_returns == 1.0).all()
    task: RobosuiteTask = ROBOSUITE_TASKS[env_id]
    layout = task.layout("paper")
    after = shipped.next_observations
    solved = task.is_success(after[:, layout["object"]], after[:, layout["robot0_eef_pos"]])
    np.testing.assert_array_equal(solved, shipped.terminations)


def write_states(path: Path, n: int = 6, size: int = 32, env_name: str = "Lift", high: bool = True) -> None:
    """A file as robosuite's collect_human_demonstrations writes it: a cube that is lifted by nobody."""
    states = np.zeros((n, size))
    states[:, 1:8] = [0.0, 0.2, 0.0, -2.6, 0.0, 2.9, 0.8]
    states[:, 10:13] = [0.0, 0.0, 0.821]
    states[:, 13] = 1.0
    if high:
        states[3:, 12] = 0.9
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env"] = env_name
        recorded = {"env_name": env_name, "robots": "Panda", "controller_configs": {"type": "OSC_POSE"}}
        data.attrs["env_info"] = json.dumps(recorded)
        demo = data.create_group("demo_1")
        demo["states"], demo["actions"] = states, np.full((n, 7), 1.5)


@pytest.mark.usefixtures("with_robosuite")
def test_robosuites_own_states_are_replayed(tmp_path: Path) -> None:
    write_states(tmp_path / "demo.hdf5")
    read = read_hdf5(tmp_path / "demo.hdf5", LIFT)
    assert read.rewards.tolist() == [0.0, 0.0, 1.0]
    assert (read.actions == 1.0).all()
    np.testing.assert_allclose(read.observations[0, :7], np.cos([0.0, 0.2, 0.0, -2.6, 0.0, 2.9, 0.8]), atol=1e-6)
    np.testing.assert_allclose(read.next_observations[2, 32:35], [0.0, 0.0, 0.9], atol=1e-6)
    write_states(tmp_path / "low.hdf5", high=False)
    low = read_hdf5(tmp_path / "low.hdf5", LIFT)
    assert (len(low), low.rewards.sum(), low.terminations.sum()) == (5, 0.0, 0)


@pytest.mark.usefixtures("with_robosuite")
def test_bad_files_of_robosuites_are_named(tmp_path: Path) -> None:
    path = tmp_path / "demo.hdf5"
    write_states(path, size=71)
    with pytest.raises(ValueError, match=rf"{path}: /data/demo_1/states .*\(6, 32\).*\(6, 71\)"):
        read_hdf5(path, LIFT)
    write_states(path, env_name="PickPlace")
    with pytest.raises(ValueError, match="env_name = 'Lift', found 'PickPlace'"):
        read_hdf5(path, LIFT)
