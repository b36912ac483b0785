"""The commands, with SB3's TD3 as the algorithm, on an environment whose returns are known by hand."""

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_actpc.cli import main
from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.experiments.demonstrators import train_demonstrator
from sb3_actpc.experiments.runs import Run, load_preset, load_run, play_episodes
from sb3_actpc.experiments.runs.evaluation import EpisodeStatistics, NormalizedPredictor
from sb3_actpc.experiments.runs.presets import find_demonstrations
from sb3_actpc.utils.files import FolderBusy
from tests.cli.line import ENV_ID, PLAIN, RESULTS, RUN, TRAIN, rows_of, train
from tests.recordings import record


class StatefulPolicy:
    """Counts the steps of each episode in its recurrent state and remembers what it was given."""

    def __init__(self) -> None:
        self.calls: list[tuple[np.ndarray, np.ndarray]] = []

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        assert deterministic
        state = np.where(episode_start, 0, 0 if state is None else state) + 1
        self.calls.append((observation.copy(), state))
        return np.zeros((len(observation), 1), dtype=np.float32), state


@pytest.mark.parametrize(("more", "is_said"), [((), True), (("--demonstrations", "none"), False)])
def test_a_run_says_when_nothing_is_shipped_for_its_environment(
    more: tuple[str, ...], is_said: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "--env", "Pendulum-v1", "--steps", "2", "--eval-episodes", "1", "--no-progress", *more]) == 0
    assert ("Pendulum-v1: no demonstrations are shipped for it" in capsys.readouterr().out) == is_said


def test_training_writes_every_file_evaluates_from_step_zero_to_the_last_and_prints_the_table(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert train("--eval-freq", "25") == 0
    names = {path.name for path in RUN.iterdir() if not path.name.startswith(".")}
    files = {"model.zip", "config.json", "result.json", "progress.csv", "episodes.csv", "diagnostics.csv"}
    assert names == {*files, "learning_curve.png", "checkpoints"}
    assert (RUN / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    for text in ("dense return", "sparse return", "success rate", "steps per second", "20.0 ± 0.0"):
        assert text in printed
    result = json.loads((RUN / "result.json").read_text(encoding="utf-8"))
    assert {name: result[name] for name in ("timesteps", *RESULTS)} == {"timesteps": 60, **RESULTS}  # the last evaluation
    assert result["versions"]["stable-baselines3"].startswith("2.")
    assert result["git_commit"] is None or len(result["git_commit"]) == 40
    rows = rows_of(RUN)
    of_actor = ["actor_return", "actor_dense_return", "actor_success"]
    assert list(rows[0]) == ["timesteps", "updates", "seconds", "evaluation_seconds", *RESULTS, *of_actor]
    assert {row[name] for row in rows for name in of_actor} == {""}  # TD3 deploys the policy that learns
    assert [int(row["timesteps"]) for row in rows] == [0, 25, 50, 60]
    # an update after every step beyond the 20 random ones; an evaluation comes before the update of its step, the last after
    assert [int(row["updates"]) for row in rows] == [0, 4, 29, 40]
    for row in rows:
        assert {name: float(row[name]) for name in RESULTS} == RESULTS
        assert float(row["evaluation_seconds"]) <= float(row["seconds"])
    seconds = [float(row["seconds"]) for row in rows]
    assert seconds == sorted(seconds)


def test_every_training_episode_is_recorded() -> None:
    """Two environments, four episodes of ten steps, each with a sparse return of 10 and a dense one of 2 * 10 * 1.5."""
    assert train("--env-kwarg", "gain=1.5", "--n-envs", "2", "--steps", "40") == 0
    with open(RUN / "episodes.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(int(row["episode"]), int(row["timesteps"])) for row in rows] == [(1, 20), (2, 20), (3, 40), (4, 40)]
    for row in rows:
        values = [float(row[name]) for name in ("length", "return", "dense_return", "success")]
        assert values == [10.0, 10.0, 30.0, 1.0]
    assert len({row["actions_crc32"] for row in rows}) == 2


def test_evaluating_does_not_change_what_is_learned() -> None:
    weights = []
    for eval_freq, output in ((7, "often"), (60, "rarely")):
        assert train("--eval-freq", str(eval_freq), "--output", output) == 0
        weights.append(TD3.load(Path(output) / "model.zip").policy.state_dict())
    assert all(bool((value == weights[1][name]).all()) for name, value in weights[0].items())


def test_settings_given_on_the_command_line_replace_the_presets() -> None:
    arguments = ["--set", "gamma=0.5", "--set", "learning_rate=1e-4", "--set", "train_freq=[2, step]"]
    assert train("--steps", "20", "--n-envs", "2", *arguments) == 0
    model = TD3.load(RUN / "model.zip")
    assert (model.gamma, model.learning_rate, model.n_envs) == (0.5, 1e-4, 2)
    assert model.train_freq == TrainFreq(2, TrainFrequencyUnit.STEP)
    record = json.loads((RUN / "config.json").read_text(encoding="utf-8"))
    assert record["settings"]["gamma"] == 0.5
    assert record["settings"]["learning_starts"] == 20


def test_a_finished_run_is_not_overwritten_and_an_unfinished_one_is(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--steps", "20", "--checkpoint-freq", "0"]
    assert train(*arguments) == 0
    before = (RUN / "result.json").read_bytes()
    assert train(*arguments) == 2
    assert "already holds a finished run: choose another folder (--output) or --seed" in capsys.readouterr().err
    assert (RUN / "result.json").read_bytes() == before
    (RUN / "result.json").unlink()
    assert train(*arguments) == 0


def test_a_folder_that_was_named_is_refused_while_another_process_trains_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    """A new run there, one that goes on, and a demonstrator; the lock is gone with its process, however that ended."""
    new = ["--steps", "20", "--output", "mine"]
    assert train(*new) == 0
    kept = {path.name: path.read_bytes() for path in Path("mine").iterdir() if path.is_file()}
    code = """if True:
        from pathlib import Path
        from sb3_actpc.utils.files import folder_lock
        with folder_lock(Path("mine")):
            print("holds it", flush=True)
            input()
    """
    on = ["train", "--resume", "mine", "--steps", "20", "--no-progress"]
    run = Run(env=ENV_ID, algo="td3", preset="small.yml", demonstrations="none", steps=40, output="mine", progress=False)
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "holds it\n"
        for refused in (lambda: train(*new), lambda: main(on)):
            assert refused() == 2
            assert "mine is in use by another process: wait until it has ended, or choose another" in capsys.readouterr().err
        with pytest.raises(FolderBusy, match="mine is in use by another process"):
            train_demonstrator(run, Path("mine"))
        assert {path.name: path.read_bytes() for path in Path("mine").iterdir() if path.is_file()} == kept
        other.kill()
    assert main(on) == 0


def test_a_run_goes_on_when_its_demonstrations_have_moved(capsys: pytest.CaptureFixture[str]) -> None:
    record(ENV_ID).save("shown.npz")
    record(ENV_ID, 3).save("others.npz")
    small = ["--set", "guidance_kwargs.bc_updates=2", "--set", "policy_kwargs.net_arch=[4]", "--eval-episodes", "1"]
    run = ["train", "--env", ENV_ID, "--demonstrations", "shown.npz", "--output", "mine", "--steps", "12", "--no-progress"]
    assert main([*run, *small]) == 0
    Path("shown.npz").rename("moved.npz")
    capsys.readouterr()
    for more, code, said in (([], 2, "shown.npz"), (["others.npz"], 2, "are not those"), (["moved.npz"], 0, "written to")):
        where = ["--demonstrations", *more] if more else []
        assert main(["train", "--resume", "mine", "--steps", "8", "--no-progress", *where]) == code
        assert said in "".join(capsys.readouterr())


def test_a_run_that_begins_anew_in_a_folder_takes_no_normalisation_over() -> None:
    arguments = ["--steps", "20", "--checkpoint-freq", "0", "--output", "mine"]
    assert train(*arguments, "--set", "normalize=true") == 0
    assert isinstance(load_run(Path("mine"))[1], NormalizedPredictor)
    Path("mine/result.json").unlink()  # it was stopped
    assert train(*arguments) == 0
    assert not isinstance(load_run(Path("mine"))[1], NormalizedPredictor)


def test_an_interrupted_run_leaves_a_whole_model(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*arguments: Any, **keywords: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(TD3, "train", interrupt)
    assert train("--eval-freq", "10") == 130
    assert not (RUN / "result.json").exists()
    assert [int(row["timesteps"]) for row in rows_of(RUN)] == [0, 10, 20]
    assert TD3.load(RUN / "model.zip").num_timesteps == 20


def test_episodes_are_played_once_each_with_the_recurrent_state_carried() -> None:
    envs = [gym.make(ENV_ID) for _ in range(2)]
    policy = StatefulPolicy()
    episodes = play_episodes(policy, envs, n_episodes=3, seed=5)
    assert episodes.dense_returns.tolist() == [20.0, 20.0, 20.0]
    assert episodes.lengths.tolist() == [10.0, 10.0, 10.0]
    # two episodes side by side, then one; the step in the observation is the state less one
    assert [len(observation) for observation, _ in policy.calls] == [2] * 10 + [1] * 10
    for observation, state in policy.calls:
        assert (observation[:, 1] + 1 == state).all()
    drawn = [env.reset(seed=seed)[0][0] for env, seed in zip([envs[0]] * 3, (5, 6, 7), strict=True)]
    assert [*policy.calls[0][0][:, 0], *policy.calls[10][0][:, 0]] == drawn


class Renamed(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Gives ``is_success`` another name."""

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray], name: str) -> None:
        super().__init__(env)
        self.name = name

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        *result, info = super().step(action)
        info[self.name] = info.pop("is_success")
        return (*result, info)  # type: ignore[return-value]


@pytest.mark.parametrize(("name", "expected"), [("is_success", 1.0), ("success", 1.0), ("another", None)])
def test_success_is_read_by_both_of_its_usual_names(name: str, expected: float | None) -> None:
    """``success`` is Adroit's and Meta-World's."""
    episodes = play_episodes(StatefulPolicy(), [Renamed(gym.make(ENV_ID), name)], n_episodes=2, seed=0)
    assert episodes.summary()["success"] == expected


def test_failed_episodes_are_counted_by_their_farthest_stage() -> None:
    rewards = np.zeros(5)
    successes = np.array([0.0, 1.0, 0.0, 0.0, 1.0])
    stages = ("grasp", "lift", "reach", "grasp", "lift")
    assert EpisodeStatistics(rewards, rewards, successes, rewards, stages).failed_after() == {"grasp": 2, "reach": 1}
    unknown = EpisodeStatistics(rewards, rewards, np.full(5, np.nan), rewards, ("",) * 5)
    assert unknown.failed_after() == {}


def test_evaluate_replays_a_run_and_writes_a_video(capsys: pytest.CaptureFixture[str]) -> None:
    assert train("--steps", "20") == 0
    capsys.readouterr()
    assert main(["evaluate", str(RUN), "--episodes", "3", "--video", "line.gif"]) == 0
    printed = capsys.readouterr().out
    assert "20.0 ± 0.0" in printed
    assert "3 episodes" in printed
    assert Path("line.gif").read_bytes().startswith(b"GIF8")
    assert main(["evaluate", str(RUN), "--episodes", "1"]) == 0
    assert (RUN / "video.mp4").stat().st_size > 0
    assert "not finished" not in capsys.readouterr().out
    (RUN / "result.json").unlink()
    assert main(["evaluate", str(RUN), "--episodes", "1", "--no-video"]) == 0
    assert (
        f"not finished: this was the agent of its last evaluation (sb3-actpc train --resume {RUN})" in capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--env", "SparseNothing-v0"], "SparseNothing"),
        (["train", "--env", "HalfCheetah"], "id: HalfCheetah (did you mean 'HalfCheetah-v"),
        (["train", "--env", ENV_ID, "--preset", "silent"], "no preset 'silent'"),
        (["train", "--env", ENV_ID, "--algo", "tdd3"], "(did you mean 'td3'?): choose one of"),
        (["train", "--env", ENV_ID, "--algo", "json:loads"], "loads of json must be a subclass of SB3's BaseAlgorithm"),
        (["train", "--env", ENV_ID, "--algo", "json:nothing"], "found None"),
        (["train", "--env", ENV_ID, "--algo", "no_such_module:Agent"], "No module named 'no_such_module'"),
        (["train", "--env", ENV_ID], "sb3-actpc demos collect --env SparseLine-v0"),
        ([*TRAIN, "--demonstrations", "no.npz"], "no.npz"),
        ([*TRAIN, "--set", "gama=1"], "did you mean 'gamma'?"),
        ([*TRAIN, "--set", "gamma"], "expected key=value"),
        ([*TRAIN, "--set", "seed=1"], "use --seed"),
        (["train", "--env", ENV_ID, "--algo", "td3", "--preset", "none.yml"], "no preset file at none.yml"),
        (["train", "--env", ENV_ID, "--device", "abacus"], "'abacus'"),
        ([*PLAIN, "--env-kwarg", "colour=red"], "colour"),
        ([*PLAIN, "--set", "policy_kwargs=[64,64]"], "policy_kwargs=[64, 64] must be a dictionary"),
        ([*PLAIN, "--set", "noise_type=normal"], "give noise_std, such as 0.1"),
        ([*PLAIN, "--steps", "many"], "steps='many' must be a number"),
        ([*PLAIN, "--env-kwarg", "gain=.nan"], "environment: info['dense_reward'] is nan: check the environment"),
        (["train", "--env", "Own-v0", "--gym-packages", "no_such_task"], "No module named 'no_such_task'"),
        (["train", "--env", "CartPole-v1", "--algo", "td3", "--preset", "small.yml"], "only supports"),
        (["train", "--env", "FrankaKitchen-v1"], "Nested observation spaces are not supported"),
        (["compare", "nowhere.yml"], "no comparison file at nowhere.yml"),
        (["evaluate", "nowhere"], "no run in nowhere: config.json is missing"),
        (["evaluate", "nowhere", "--video", "film.avi"], "must end in .mp4 or .gif"),
    ],
)
def test_mistakes_give_one_line_and_exit_code_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    errors = capsys.readouterr().err.strip()
    assert message in errors
    assert errors.startswith("sb3-actpc: error: ")
    assert "\n" not in errors
    assert not list(Path("runs").rglob("result.json"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("default: &a {policy_kwargs: *a}", "maximum recursion depth exceeded"),
        ("default: {n_envs: .nan}", "n_envs=nan must be a finite number"),
        ("default: {replay_buffer_class: HerReplayBuffer}", "replay_buffer_class='HerReplayBuffer' does not keep"),
        ("default: {policy_kwargs: {net_arch: [1048576, 1048576, 1048576]}}", "memory"),
        ("default: []", "p.yml"),
        ("[1]", "p.yml"),
        ("\0", "p.yml"),
    ],
)
def test_a_preset_that_cannot_be_used_gives_one_line_too(text: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("p.yml").write_text(text, encoding="utf-8")
    command = ["train", "--env", ENV_ID, "--preset", "p.yml", "--demonstrations", "none", "--steps", "12"]
    assert main([*command, "--no-progress"]) == 2
    errors = capsys.readouterr().err.strip()
    assert message in errors and "\n" not in errors


def test_presets_are_plain_and_an_entry_replaces_the_default() -> None:
    text = "default: {gamma: 0.9, tau: 1e-2}\nSparseLine-v0: {policy_kwargs: {optimizer_kwargs: {eps: 1e-5}}}"
    Path("p.yml").write_text(text, encoding="utf-8")
    assert load_preset("p.yml", "Other-v0") == {"gamma": 0.9, "tau": 0.01}
    for env_id in (ENV_ID, f"module.of.mine:{ENV_ID}"):
        assert load_preset("p.yml", env_id) == {"policy_kwargs": {"optimizer_kwargs": {"eps": 1e-5}}}
    Path("p.yml").write_text("default: !!python/object/apply:os.getcwd []", encoding="utf-8")
    with pytest.raises(ValueError, match="not YAML of plain values"):
        load_preset("p.yml", ENV_ID)


@pytest.mark.parametrize("command", [["train", "--env", ENV_ID, "--preset", "p.yml"], ["compare", "p.yml"]])
def test_a_key_that_is_given_twice_is_named_with_its_file_and_line(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("p.yml").write_text("default:\n  gamma: 0.9\n  tau: 0.1\n  gamma: 0.8\n", encoding="utf-8")
    assert main(command) == 2
    message = "p.yml: not YAML of plain values with unique keys (line 4: the key 'gamma' is given twice)"
    assert message in capsys.readouterr().err


# mean dense returns that the shipped demonstrators must reach; the paper's agents are compared with such ones
AIMS = {"HalfCheetah": 5500.0, "Walker2d": 3000.0, "Hopper": 2200.0, "Swimmer": 100.0, "Reacher": -6.0}


@pytest.mark.parametrize("task", AIMS)
def test_every_task_ships_good_successful_demonstrations_and_the_command_that_made_them(task: str) -> None:
    demonstrations = Demonstrations.load(find_demonstrations(f"Sparse{task}-v5", "shipped"))
    assert demonstrations.n_episodes == {"HalfCheetah": 8, "Swimmer": 10}.get(task, 20)
    assert demonstrations.dense_returns.mean() >= AIMS[task]
    assert (demonstrations.episode_returns > 0).all()
    assert demonstrations.metadata["command"].startswith(f"sb3-actpc demos collect --env Sparse{task}-v5")
    env = make_vec_env(f"Sparse{task}-v5")
    demonstrations.check(env.observation_space, env.action_space, f"Sparse{task}-v5")
    assert np.array_equal(demonstrations.rewarded_by(env).rewards, demonstrations.rewards)
    env.close()


@pytest.mark.parametrize("env_id", ["SparseReacher-v4", "GoalReacher-v4"])
def test_a_version_of_other_observations_than_the_shipped_files_says_how_to_get_its_own(env_id: str) -> None:
    with pytest.raises(FileNotFoundError, match=r"no demonstrations of SparseReacher-v4 are shipped: collect .*--demonstr"):
        find_demonstrations(env_id, "shipped")


def test_a_pipe_that_is_closed_early_is_no_error() -> None:
    command = f"{sys.executable} -m sb3_actpc list presets | true; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("0", "")
