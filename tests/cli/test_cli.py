"""The commands, with SB3's TD3 as the algorithm, on an environment whose returns are known by hand."""

import csv
import json
import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_actpc.cli import main
from sb3_actpc.demonstrations.dataset import DATA_FOLDER, Demonstrations
from sb3_actpc.envs import SPARSE_MUJOCO_IDS
from sb3_actpc.experiments.demonstrators import train_demonstrator
from sb3_actpc.experiments.runs import Run, load_preset, load_run, play_episodes, train_run
from sb3_actpc.experiments.runs.evaluation import EpisodeStatistics, EvaluationCallback, NormalizedPredictor
from sb3_actpc.experiments.runs.presets import find_demonstrations, parse_assignments, parse_schedule
from sb3_actpc.experiments.runs.video import RenderingUnavailable, choose_gl_backend
from sb3_actpc.utils.files import FolderBusy
from tests.cli.line import ENV_ID, RESULTS, RUN, TRAIN, SilentTD3, rows_of, train

PLAIN = [*TRAIN, "--demonstrations", "none"]


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


def write_demonstrations(path: Path, dense_reward: float) -> None:
    """Two episodes of three steps."""
    Demonstrations(
        observations=np.zeros((6, 2)),
        actions=np.zeros((6, 1)),
        next_observations=np.ones((6, 2)),
        rewards=np.ones(6),
        terminations=np.array([False, False, True] * 2),
        episode_starts=np.array([0, 3]),
        env_id=ENV_ID,
        dense_rewards=np.full(6, dense_reward),
    ).save(path)


def test_training_writes_every_file_and_prints_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert train("--demonstrations", "none", "--eval-freq", "20", "--eval-episodes", "2") == 0
    names = {path.name for path in RUN.iterdir()}
    assert names == {
        "model.zip",
        "config.json",
        "result.json",
        "progress.csv",
        "episodes.csv",
        "diagnostics.csv",
        "learning_curve.png",
        "checkpoints",
    }
    assert (RUN / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    for text in ("dense return", "demonstrators", "sparse return", "success rate", "steps per second", "20.0 ± 0.0"):
        assert text in printed


@pytest.mark.parametrize(("more", "is_said"), [((), True), (("--demonstrations", "none"), False)])
def test_a_run_says_when_nothing_is_shipped_for_its_environment(
    more: tuple[str, ...], is_said: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "--env", "Pendulum-v1", "--steps", "2", "--eval-episodes", "1", "--no-progress", *more]) == 0
    assert ("Pendulum-v1: no demonstrations are shipped for it" in capsys.readouterr().out) == is_said


def test_a_comparison_says_so_too_of_algorithms_that_would_imitate(capsys: pytest.CaptureFixture[str]) -> None:
    tasks = ("--envs", "Pendulum-v1", "SparseHopper-v5", "--seeds", "2", "--dry-run")
    assert main(["compare", "--algos", "actpc", "no_guidance", *tasks]) == 0
    assert capsys.readouterr().out.count("no demonstrations are shipped") == 1
    assert main(["compare", "--algos", "ppo", *tasks]) == 0
    assert "no demonstrations" not in capsys.readouterr().out


def test_evaluations_are_of_the_dense_task_from_step_zero_to_the_last() -> None:
    assert train("--demonstrations", "none", "--eval-freq", "25") == 0
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
    """Six episodes of ten steps, each with a sparse return of 10 and a dense one of 2 * 10 * 1.5."""
    assert train("--demonstrations", "none", "--env-kwarg", "gain=1.5") == 0
    with open(RUN / "episodes.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["episode"]) for row in rows] == [1, 2, 3, 4, 5, 6]
    assert [int(row["timesteps"]) for row in rows] == [10, 20, 30, 40, 50, 60]
    for row in rows:
        values = [float(row[name]) for name in ("length", "return", "dense_return", "success")]
        assert values == [10.0, 10.0, 30.0, 1.0]
    assert len({row["actions_crc32"] for row in rows}) == 6


def test_the_episodes_of_parallel_environments_are_kept_apart() -> None:
    assert train("--demonstrations", "none", "--n-envs", "2", "--steps", "40") == 0
    with open(RUN / "episodes.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(int(row["episode"]), int(row["timesteps"])) for row in rows] == [(1, 20), (2, 20), (3, 40), (4, 40)]
    assert {float(row["dense_return"]) for row in rows} == {20.0}


def test_the_settings_say_how_to_repeat_the_run() -> None:
    assert train("--demonstrations", "none", "--steps", "20", "--seed", "3", "--threads", "1") == 0
    record = json.loads(Path(f"runs/{ENV_ID}/td3_small_seed3/config.json").read_text(encoding="utf-8"))
    assert (record["seed"], record["threads"], record["n_timesteps"], record["demonstrations"]) == (3, 1, 20, "none")
    assert record["versions"]["stable-baselines3"].startswith("2.")
    assert record["git_commit"] is None or len(record["git_commit"]) == 40


def test_the_result_is_the_last_evaluation() -> None:
    result = train_run(
        Run(
            env=ENV_ID,
            algo="td3",
            preset="small.yml",
            demonstrations="none",
            env_kwargs={"gain": 3.0},
            progress=False,
            n_timesteps=30,
        )
    )
    assert result["dense_return"] == 60.0
    assert result["return"] == 10.0
    assert result["success"] == 1.0
    assert result["timesteps"] == 30
    assert result["demonstrators_return"] is None
    assert result["steps_per_second"] > 0
    stored = json.loads(Path(result["folder"], "result.json").read_text(encoding="utf-8"))
    assert {**stored, "folder": result["folder"]} == result


def test_the_demonstrators_return_is_the_mean_over_their_episodes() -> None:
    write_demonstrations(Path("demos.npz"), dense_reward=1.5)
    result = train_run(Run(env=ENV_ID, algo="td3", preset="small.yml", demonstrations="demos.npz", progress=False))
    assert result["demonstrators_return"] == 4.5


def test_an_algorithm_with_a_keyword_for_demonstrations_is_given_them() -> None:
    write_demonstrations(Path("demos.npz"), dense_reward=1.0)
    Path("plain.yml").write_text("default: {n_timesteps: 20}", encoding="utf-8")
    train_run(Run(env=ENV_ID, algo="silent", preset="plain.yml", demonstrations="demos.npz", progress=False))
    assert SilentTD3.received == Path("demos.npz")
    train_run(Run(env=ENV_ID, algo="silent", preset="plain.yml", demonstrations="none", progress=False, seed=1))
    assert SilentTD3.received is None


def test_a_learning_rate_can_fall_linearly_to_zero() -> None:
    schedule = parse_schedule("lin_4e-4")
    assert callable(schedule) and [schedule(left) for left in (1.0, 0.5, 0.0)] == pytest.approx([4e-4, 2e-4, 0.0])
    assert parse_schedule(1e-3) == 1e-3
    for wrong in ("exp_1e-3", "fast", "lin_fast"):
        with pytest.raises(ValueError, match="lin_<number>"):
            parse_schedule(wrong)


def test_evaluating_does_not_change_what_is_learned() -> None:
    weights = []
    for eval_freq, output in ((7, "often"), (60, "rarely")):
        assert train("--demonstrations", "none", "--eval-freq", str(eval_freq), "--output", output) == 0
        weights.append(TD3.load(Path(output) / "model.zip").policy.state_dict())
    assert all(bool((value == weights[1][name]).all()) for name, value in weights[0].items())


def test_a_resumed_run_is_not_evaluated_as_if_it_were_new(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It would be the best so far, as nothing is known yet of those before, and be kept in the place of the best."""
    played: list[int] = []
    monkeypatch.setattr(EvaluationCallback, "_evaluate", lambda self, n_episodes=None: played.append(self.num_timesteps))
    for steps, expected in ((70, []), (0, [0])):
        evaluation = EvaluationCallback([], tmp_path, 10, 5, 0, print, keeps_best=True)
        evaluation.model, evaluation.num_timesteps = TD3("MlpPolicy", "Pendulum-v1", buffer_size=1), steps
        evaluation.on_rollout_start()
        assert played == expected


def test_settings_given_on_the_command_line_replace_the_presets() -> None:
    arguments = ["--set", "gamma=0.5", "--set", "learning_rate=1e-4", "--set", "train_freq=[2, step]"]
    assert train("--demonstrations", "none", "--steps", "20", "--n-envs", "2", *arguments) == 0
    model = TD3.load(RUN / "model.zip")
    assert (model.gamma, model.learning_rate, model.n_envs) == (0.5, 1e-4, 2)
    assert model.train_freq == TrainFreq(2, TrainFrequencyUnit.STEP)
    record = json.loads((RUN / "config.json").read_text(encoding="utf-8"))
    assert record["settings"]["gamma"] == 0.5
    assert record["settings"]["learning_starts"] == 20


def test_action_noise_is_read_from_plain_values() -> None:
    assert train("--demonstrations", "none", "--steps", "20", "--set", "noise_type=normal", "--set", "noise_std=0.3") == 0
    noise = TD3.load(RUN / "model.zip").action_noise
    assert noise is not None
    assert np.std([noise()[0] for _ in range(500)]) == pytest.approx(0.3, rel=0.2)


def test_a_finished_run_is_not_overwritten_and_an_unfinished_one_is() -> None:
    arguments = ["--demonstrations", "none", "--steps", "20", "--checkpoint-freq", "0"]
    assert train(*arguments) == 0
    before = (RUN / "result.json").read_bytes()
    assert train(*arguments) == 0
    second = RUN.with_name(f"{RUN.name}_2")
    assert (RUN / "result.json").read_bytes() == before
    (second / "result.json").unlink()
    assert train(*arguments) == 0
    assert (second / "result.json").exists()
    assert not RUN.with_name(f"{RUN.name}_3").exists()


def test_a_folder_in_which_another_process_trains_is_not_taken() -> None:
    """The other has written nothing that tells it from a stopped one; its folder is free again when it is killed."""
    code = """if True:
        from sb3_actpc.experiments.runs import Run
        from sb3_actpc.experiments.runs.run import default_folder
        with default_folder(Run(env="SparseLine-v0", algo="td3", preset="small.yml")):
            print("holds it", flush=True)
            input()
    """
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "holds it\n"
        assert train("--demonstrations", "none", "--steps", "20") == 0
        assert sorted(path.name for path in RUN.parent.iterdir()) == [RUN.name, f"{RUN.name}_2"]
        assert not (RUN / "result.json").exists()
        other.kill()
    assert train("--demonstrations", "none", "--steps", "20") == 0
    assert (RUN / "result.json").exists() and not (RUN / ".lock").exists()


def test_a_folder_that_was_named_is_refused_while_another_process_trains_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    """A new run there, one that goes on, and a demonstrator; the lock is gone with its process, however that ended."""
    new = ["--demonstrations", "none", "--steps", "20", "--output", "mine"]
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


def test_a_run_that_begins_anew_in_a_folder_takes_no_normalisation_over() -> None:
    arguments = ["--demonstrations", "none", "--steps", "20", "--checkpoint-freq", "0", "--output", "mine"]
    assert train(*arguments, "--set", "normalize=true") == 0
    assert isinstance(load_run(Path("mine"))[1], NormalizedPredictor)
    Path("mine/result.json").unlink()  # it was stopped
    assert train(*arguments) == 0
    assert not isinstance(load_run(Path("mine"))[1], NormalizedPredictor)


def test_an_explicit_folder_that_holds_a_finished_run_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--demonstrations", "none", "--steps", "20", "--output", "mine"]
    assert train(*arguments) == 0
    assert train(*arguments) == 2
    assert "mine already holds a finished run" in capsys.readouterr().err


def test_an_interrupted_run_leaves_a_whole_model(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*arguments: Any, **keywords: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(TD3, "train", interrupt)
    assert train("--demonstrations", "none", "--eval-freq", "10") == 130
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


def test_failed_episodes_are_counted_by_their_farthest_stage() -> None:
    rewards = np.zeros(5)
    successes = np.array([0.0, 1.0, 0.0, 0.0, 1.0])
    stages = ("grasp", "lift", "reach", "grasp", "lift")
    assert EpisodeStatistics(rewards, rewards, successes, rewards, stages).failed_after() == {"grasp": 2, "reach": 1}
    unknown = EpisodeStatistics(rewards, rewards, np.full(5, np.nan), rewards, ("",) * 5)
    assert unknown.failed_after() == {}


def test_success_is_unknown_where_the_environment_does_not_report_it() -> None:
    model = TD3("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [4]}, buffer_size=10)
    episodes = play_episodes(model, [gym.make("Pendulum-v1")], n_episodes=1, seed=0)
    assert episodes.summary()["success"] is None
    assert episodes.dense_returns == episodes.returns


def test_evaluate_replays_a_run_and_writes_a_video(capsys: pytest.CaptureFixture[str]) -> None:
    assert train("--demonstrations", "none", "--steps", "20") == 0
    capsys.readouterr()
    assert main(["evaluate", str(RUN), "--episodes", "3", "--video", "line.gif"]) == 0
    printed = capsys.readouterr().out
    assert "20.0 ± 0.0" in printed
    assert "3 episodes" in printed
    assert Path("line.gif").read_bytes().startswith(b"GIF8")
    assert main(["evaluate", str(RUN), "--episodes", "1", "--video", "line.png"]) == 0
    assert imageio.imread("line.png").shape == (16, 6 * 24, 3)  # six pictures at half the size
    assert main(["evaluate", str(RUN), "--episodes", "1"]) == 0
    assert (RUN / "video.mp4").stat().st_size > 0
    assert "not finished" not in capsys.readouterr().out
    (RUN / "result.json").unlink()
    assert main(["evaluate", str(RUN), "--episodes", "1", "--no-video"]) == 0
    assert (
        f"not finished: this was the agent of its last evaluation (sb3-actpc train --resume {RUN})" in capsys.readouterr().out
    )


def test_the_demonstrator_beside_is_the_one_that_the_run_had(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert train("--demonstrations", "none", "--steps", "20") == 0
    beside = ["evaluate", str(RUN), "--episodes", "1", "--video", "line.gif", "--beside-demonstrator"]
    assert main(beside) == 2
    assert "leave --beside-demonstrator out" in capsys.readouterr().err
    config = json.loads((RUN / "config.json").read_text(encoding="utf-8"))
    (RUN / "config.json").write_text(json.dumps({**config, "demonstrations": "shipped"}), encoding="utf-8")
    write_demonstrations(Path("others.npz"), dense_reward=1.0)
    shipped = "sb3_actpc.experiments.runs.presets.shipped_demonstrations"
    monkeypatch.setattr(shipped, lambda env_id: Path("others.npz"))
    recorded: list[Any] = []
    monkeypatch.setattr("sb3_actpc.experiments.runs.video.record_video", lambda *arguments: recorded.append(arguments) or 1)
    assert main(beside) == 0
    assert recorded[0][-1].n_episodes == 2


def test_evaluate_goes_on_where_nothing_can_be_rendered(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert train("--demonstrations", "none", "--steps", "20") == 0

    def fail(*arguments: Any) -> int:
        raise RenderingUnavailable("no display")

    monkeypatch.setattr("sb3_actpc.experiments.runs.video.record_video", fail)
    assert main(["evaluate", str(RUN), "--episodes", "1"]) == 0
    assert "no video: rendering is not available here (no display)" in capsys.readouterr().out


def test_the_first_graphics_backend_that_works_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "mine")
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    for working in ("mine", "egl", "osmesa"):
        probe = "sb3_actpc.experiments.runs.video._probe"
        monkeypatch.setattr(probe, lambda variables, name=working: variables["MUJOCO_GL"] == name)
        assert choose_gl_backend() == working
        assert os.environ["MUJOCO_GL"] == working


def test_a_graphics_backend_that_does_not_work_is_set_aside(monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo cannot even be imported when ``MUJOCO_GL`` names one."""
    monkeypatch.setenv("MUJOCO_GL", "mine")
    monkeypatch.setattr("sb3_actpc.experiments.runs.video._probe", lambda variables: False)
    assert choose_gl_backend() is None
    assert "MUJOCO_GL" not in os.environ


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--env", "SparseNothing-v0"], "SparseNothing"),
        (["train", "--env", "HalfCheetah"], "id: HalfCheetah (did you mean 'HalfCheetah-v"),
        (["train", "--env", ENV_ID, "--algo", "silent"], "no preset 'silent'"),
        (["train", "--env", ENV_ID, "--algo", "unknown"], "algo='unknown' is no algorithm"),
        (TRAIN, "sb3-actpc demos collect --env SparseLine-v0"),
        ([*TRAIN, "--demonstrations", "no.npz"], "no.npz"),
        ([*TRAIN, "--set", "gama=1"], "did you mean 'gamma'?"),
        ([*TRAIN, "--set", "gamma"], "expected key=value"),
        ([*TRAIN, "--set", "seed=1"], "use --seed"),
        (["train", "--env", ENV_ID, "--algo", "td3", "--preset", "none.yml"], "no preset file at none.yml"),
        (["train", "--env", ENV_ID, "--steps", "0"], "steps='0' must be at least 1"),
        (["train", "--env", ENV_ID, "--device", "abacus"], "'abacus'"),
        ([*TRAIN, "--demonstrations", "none", "--env-kwarg", "colour=red"], "colour"),
        ([*PLAIN, "--set", "policy_kwargs=[64,64]"], "policy_kwargs=[64, 64] must be a dictionary"),
        ([*PLAIN, "--set", "normalize={norm_ob: false}"], "no keyword 'norm_ob' (did you mean 'norm_obs'?): choose from"),
        ([*PLAIN, "--set", "noise_std=0.3"], "noise_std=0.3 is of no noise: give noise_type=normal too"),
        (["bench", "--device", "foo"], "device='foo' must be"),
        (["train", "--env", "CartPole-v1", "--algo", "td3", "--preset", "small.yml"], "only supports"),
        (["evaluate", "nowhere"], "no run in nowhere: config.json is missing"),
        (["evaluate", "nowhere", "--video", "film.avi"], "must end in .mp4, .gif or .png"),
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
    assert not Path("runs").exists()


def test_what_is_no_runs_folder_is_told_from_one(capsys: pytest.CaptureFixture[str]) -> None:
    """The folder of a comparison, or of all runs; a file of a run; and where there is nothing."""
    folders = [Path("all", *parts) for parts in (("line", "td3", "seed0"), ("line", "td3", "seed1"), ("other",))]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "config.json").write_text("{}", encoding="utf-8")
    Path("all/other/model.zip").touch()
    Path("empty").mkdir()
    for given, message in (
        ("all", f"config.json is missing; runs in it: {folders[2]}, {folders[0]}, {folders[1]}\n"),
        ("all/line", f"config.json is missing; runs in it: {folders[0]}, {folders[1]}\n"),
        ("all/other/model.zip", "config.json is missing; a run is a folder, as sb3-actpc train writes it: all/other\n"),
        ("empty", "config.json is missing; a run is a folder, as sb3-actpc train writes it\n"),
    ):
        assert main(["evaluate", given, "--no-video"]) == 2
        assert capsys.readouterr().err == f"sb3-actpc: error: no run in {given}: {message}"


def test_debug_shows_where_an_error_came_from() -> None:
    with pytest.raises(FileNotFoundError):
        main(["--debug", "evaluate", "nowhere"])


def test_a_damaged_run_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    Path("run").mkdir()
    Path("run/model.zip").write_bytes(b"nonsense")
    Path("run/config.json").write_text("[]", encoding="utf-8")
    assert main(["evaluate", "run"]) == 2
    assert "expected the settings of a run" in capsys.readouterr().err
    settings = {"env": ENV_ID, "env_kwargs": {}, "algo": "td3", "seed": 0}
    Path("run/config.json").write_text(json.dumps(settings), encoding="utf-8")
    assert main(["evaluate", "run"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_presets_are_plain_and_an_entry_replaces_the_default() -> None:
    text = "default: {gamma: 0.9, tau: 1e-2}\nSparseLine-v0: {policy_kwargs: {optimizer_kwargs: {eps: 1e-5}}}"
    Path("p.yml").write_text(text, encoding="utf-8")
    assert load_preset("p.yml", "Other-v0") == {"gamma": 0.9, "tau": 0.01}
    for env_id in (ENV_ID, f"module.of.mine:{ENV_ID}"):
        assert load_preset("p.yml", env_id) == {"policy_kwargs": {"optimizer_kwargs": {"eps": 1e-5}}}
    Path("p.yml").write_text("default: !!python/object/apply:os.getcwd []", encoding="utf-8")
    with pytest.raises(ValueError, match="not YAML of plain values"):
        load_preset("p.yml", ENV_ID)


def test_the_shipped_preset_has_settings_for_every_task() -> None:
    for env_id in ("SparseHalfCheetah-v5", "Anything-v0"):
        assert load_preset("actpc", env_id)["n_timesteps"] >= 1


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


@pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")
@pytest.mark.parametrize("env_id", sorted({*SPARSE_MUJOCO_IDS} - {"SparseReacher-v4"}))
def test_the_shipped_file_fits_both_versions_of_the_other_tasks(env_id: str) -> None:
    with closing(gym.make(env_id)) as env:
        Demonstrations.load(find_demonstrations(env_id, "shipped")).check(env.observation_space, env.action_space, env_id)


def test_shipped_files_stay_below_4_megabytes() -> None:
    assert sum(path.stat().st_size for path in DATA_FOLDER.glob("*.npz")) < 4e6


def test_assignments_are_read_as_yaml() -> None:
    texts = ["a=1", "b=1e-3", "c=true", "d=[1, 2]", "e=x=y", "f="]
    assert parse_assignments(texts) == {"a": 1, "b": 0.001, "c": True, "d": [1, 2], "e": "x=y", "f": None}


def test_a_dense_task_needs_no_demonstrations() -> None:
    assert find_demonstrations("Pendulum-v1", "shipped") is None


def test_help_is_quick_and_lists_the_commands() -> None:
    code = "import sys; from sb3_actpc.cli import main; sys.exit(main(['--help']))"
    root = Path(__file__).resolve().parents[2]
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root, timeout=60, check=False)
    assert result.returncode == 0
    for command in ("train", "evaluate", "demos"):
        assert command in result.stdout


def test_a_pipe_that_is_closed_early_is_no_error() -> None:
    command = f"{sys.executable} -m sb3_actpc list presets | true; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("0", "")
