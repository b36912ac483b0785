"""What a user may choose on the command line: steps, settings, own environments, more steps, TensorBoard."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback

import sb3_actpc
from sb3_actpc.checkpoints import TrainingStopped
from sb3_actpc.cli import main
from sb3_actpc.demonstrations import Demonstrations
from sb3_actpc.experiments.runs import Run, finish_run
from sb3_actpc.experiments.runs.episode_log import dense_reward
from tests.cli.line import ENV_ID, RUN, rows_of, train
from tests.recordings import write_minari

ROOT = Path(__file__).resolve().parents[2]
OWN_TASK = """
import gymnasium as gym
import numpy as np


class Own(gym.Env):
    def __init__(self):
        box = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = gym.spaces.Dict({"a": box, "b": box})
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self._observation(), {}

    def step(self, action):
        self.count += 1
        return self._observation(), 1.0, self.count == 5, False, {}

    def _observation(self):
        return {"a": np.zeros(2, np.float32), "b": np.ones(2, np.float32)}


gym.register("Own-v0", Own)
"""


class StopAt(BaseCallback):
    """Tells its own process to stop."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        if self.num_timesteps == self.step:
            os.kill(os.getpid(), signal.SIGTERM)
        return True


def test_the_package_is_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sb3_actpc", "--version"], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout == f"sb3-actpc {sb3_actpc.__version__}\n"


def test_public_names_are_completed() -> None:
    assert {"ActPC", "preset", "Demonstrations"} <= set(dir(sb3_actpc))


@pytest.mark.parametrize(
    ("kind", "found"),
    [("tasks", "SparseHopper-v5"), ("algos", "td3"), ("variants", "no_guidance  "), ("demos", "20 episodes")],
)
def test_what_there_is_can_be_listed(kind: str, found: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", kind]) == 0
    assert found in (listed := capsys.readouterr().out)
    assert ("no_guidance" in listed) == (kind == "variants")


@pytest.mark.filterwarnings("ignore:.*is set to None:UserWarning", "ignore:env_spec is None:UserWarning")
def test_a_minari_dataset_is_named_by_its_id(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("h5py")
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(Path("sets").absolute()))
    shown = Demonstrations.record(lambda _: np.zeros(1), ENV_ID, 2, only_successes=False)
    write_minari(shown, "line/still-v0", gym.make(ENV_ID))
    quick = ["train", "--env", ENV_ID, "--steps", "20", "--no-progress", "--output", "mine"]
    quick += ["--set", "guidance_kwargs.bc_updates=3"]
    assert main([*quick, "--demonstrations", "line/moving-v0"]) == 2
    assert "fetch it with `minari download line/moving-v0`" in capsys.readouterr().err
    assert main([*quick, "--demonstrations", "line/still-v0"]) == 0
    record = json.loads(Path("mine/config.json").read_text(encoding="utf-8"))
    assert (record["demonstrations"], record["demonstrators_return"]) == ("line/still-v0", 20.0)
    agent = sb3_actpc.ActPC.load("mine/model.zip", env=gym.make(ENV_ID))
    assert agent.demonstrations == "line/still-v0" and len(agent.expert) == len(shown)
    resume = ["train", "--resume", "mine", "--steps", "10", "--no-progress"]
    assert main(resume) == 0
    shutil.rmtree("sets")
    write_minari(shown.select(1), "line/still-v0", gym.make(ENV_ID))  # another set under the same name
    assert main(resume) == 2
    assert "the demonstrations (line/still-v0) are not those that the run began with" in capsys.readouterr().err


def test_the_zoos_help_lists_its_commands(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["zoo", "--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert all(command in shown for command in ("train", "optimize", "enjoy", "plot"))


def test_steps_and_settings_as_people_write_them() -> None:
    assert train("--demonstrations", "none", "--steps", "2e1", "--set", "policy_kwargs.net_arch=[5,6]") == 0
    model = TD3.load(RUN / "model.zip")
    assert model.num_timesteps == 20
    assert [layer.out_features for layer in model.actor.mu if hasattr(layer, "out_features")] == [5, 6, 1]


OWN_ALGORITHMS = """
import sb3_actpc
import stable_baselines3

class OwnTD3(stable_baselines3.TD3):
    pass

class OwnActPC(sb3_actpc.ActPC):
    pass
"""


def test_an_algorithm_of_the_working_folder_is_trained_replayed_and_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The worker of the comparison, another process, finds it as well."""
    (tmp_path / "own_algorithms.py").write_text(OWN_ALGORITHMS, encoding="utf-8")
    (tmp_path / "own_task.py").write_text(OWN_TASK, encoding="utf-8")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(tmp_path))])
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    quick = ["--steps", "20", "--eval-episodes", "1", "--no-progress"]
    own = ["--algo", "own_algorithms:OwnTD3", "--env", "own_task:Own-v0", "--preset", "small.yml"]
    assert main(["train", *own, *quick]) == 0
    assert main(["evaluate", "runs/own_task_Own-v0/OwnTD3_small_seed0", "--episodes", "1", "--no-video"]) == 0
    algos = {"preset": "small.yml", "algo": "own_algorithms:OwnTD3"}
    Path("c.yml").write_text(json.dumps({"envs": ["own_task:Own-v0"], "algos": [algos], "seeds": 1}), encoding="utf-8")
    assert main(["compare", "c.yml", *quick, "--workers", "1"]) == 0
    assert "1 of 1 runs are finished" in capsys.readouterr().out
    assert len(list(Path("runs/comparison/own_task_Own-v0/OwnTD3").glob("*/result.json"))) == 1
    assert main(["compare", "--envs", "SparseReacher-v5", "--algos", "own_algorithms:OwnActPC", "--dry-run"]) == 0


@pytest.mark.parametrize(
    ("algo", "message"),
    [
        ("json:loads", "loads of json must be a subclass of SB3's BaseAlgorithm"),
        ("json:nothing", "found None"),
        ("no_such_module:Agent", "No module named 'no_such_module'"),
        ("tdd3", "(did you mean 'td3'?): choose one of"),
    ],
)
def test_what_is_no_algorithm_is_refused(algo: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "--env", ENV_ID, "--algo", algo, "--steps", "5"]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("option", ["steps", "eval-freq", "checkpoint-freq"])
@pytest.mark.parametrize(
    ("text", "message"),
    [("1.5", "=1.5 must be a whole number"), ("many", "='many' must be a number"), ("inf", "must be a finite number"),
     ("nan", "must be a finite number"), ("-1", "='-1' must be at least")],
)  # fmt: skip
def test_steps_that_are_no_whole_number_are_refused(
    option: str, text: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(f"--{option}", text) == 2
    assert message in (line := capsys.readouterr().err) and option.replace("-", "_") in line


def test_an_environment_of_the_working_folder_with_observations_of_two_parts_and_one_reward(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own_task.py").write_text(OWN_TASK, encoding="utf-8")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(tmp_path))])
    command = ["train", "--env", "Own-v0", "--algo", "td3", "--preset", "small.yml", "--gym-packages", "own_task"]
    assert main([*command, "--steps", "30", "--no-progress", "--output", "own"]) == 0
    record = json.loads(Path("own/config.json").read_text(encoding="utf-8"))
    assert (record["policy"], record["gym_packages"]) == ("MultiInputPolicy", ["own_task"])
    assert main(["evaluate", "own", "--episodes", "1", "--no-video"]) == 0
    printed = capsys.readouterr().out
    assert "step       30  return       5.0" in printed and "\nreturn  " in printed and "dense" not in printed


@pytest.mark.parametrize("named", [["--env", "Own-v0", "--gym-packages", "no_such_task"], ["--env", "no_such_task:Own-v0"]])
def test_a_module_that_is_not_there_is_asked_for(named: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", *named, "--algo", "td3", "--preset", "small.yml"]) == 2
    assert "'no_such_task', which is to register an environment: run the command in the folder" in capsys.readouterr().err


def test_what_a_module_of_ones_own_lacks_is_no_module_of_ones_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lacking_task.py").write_text("import no_such_library\n", encoding="utf-8")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(tmp_path))])
    assert main(["train", "--env", "lacking_task:Own-v0", "--algo", "td3", "--preset", "small.yml"]) == 2
    assert capsys.readouterr().err.strip() == "sb3-actpc: error: No module named 'no_such_library'"


def test_a_finished_run_is_given_more_steps(capsys: pytest.CaptureFixture[str]) -> None:
    """It ends as one that was to have them from the beginning, its evaluations at the former end apart."""
    straight = ["--demonstrations", "none", "--eval-freq", "20", "--steps", "60", "--output", "straight"]
    assert train(*straight) == 0
    assert train(*[{"60": "40", "straight": "more"}.get(word, word) for word in straight]) == 0
    assert main(["train", "--resume", "more", "--no-progress"]) == 2
    assert "is finished: say with --steps how many more it shall have" in capsys.readouterr().err
    assert main(["train", "--resume", "more", "--steps", "many"]) == 2
    assert "steps='many' must be a number" in capsys.readouterr().err
    assert main(["train", "--resume", "more", "--steps", "2e1", "--no-progress"]) == 0
    assert "60 steps from step 40" in capsys.readouterr().out
    assert [int(row["timesteps"]) for row in rows_of("more")] == [0, 20, 40, 60]
    assert json.loads(Path("more/result.json").read_text(encoding="utf-8"))["timesteps"] == 60
    weights = [TD3.load(f"{name}/model.zip").policy.state_dict() for name in ("straight", "more")]
    assert all(bool((value == weights[1][name]).all()) for name, value in weights[0].items())
    assert len(list(Path("more/checkpoints").iterdir())) == 1


def test_a_finished_run_without_a_checkpoint_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert train("--demonstrations", "none", "--steps", "20", "--checkpoint-freq", "0", "--output", "mine") == 0
    assert main(["train", "--resume", "mine", "--steps", "20"]) == 2
    assert "kept no checkpoint to go on from" in capsys.readouterr().err


def test_a_stopped_run_without_a_checkpoint_is_not_begun_anew_in_its_place(capsys: pytest.CaptureFixture[str]) -> None:
    """Unless it has nothing to lose."""
    assert train("--demonstrations", "none", "--steps", "20", "--checkpoint-freq", "0", "--output", "mine") == 0
    Path("mine/result.json").unlink()  # it was stopped
    kept = {name: Path("mine", name).read_bytes() for name in ("progress.csv", "model.zip", "episodes.csv")}
    assert main(["train", "--resume", "mine", "--no-progress"]) == 2
    assert "has evaluations but no checkpoint to go on from, and would begin anew" in capsys.readouterr().err
    assert {name: Path("mine", name).read_bytes() for name in kept} == kept
    rows = Path("mine/progress.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    Path("mine/progress.csv").write_text("".join(rows[:2]) + "2", encoding="utf-8")  # the rest was not written
    assert main(["train", "--resume", "mine", "--no-progress"]) == 2
    Path("mine/progress.csv").write_text("".join(rows[:2]), encoding="utf-8")
    assert main(["train", "--resume", "mine", "--no-progress"]) == 0


@pytest.mark.parametrize("reward", ["nan", "inf"])
def test_a_dense_reward_that_is_no_number_is_the_environments(reward: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert train("--demonstrations", "none", "--steps", "20", "--env-kwarg", f"gain=.{reward}", "--output", "mine") == 2
    assert f"environment: info['dense_reward'] is {reward}: check the environment" in capsys.readouterr().err


def test_a_reward_that_is_no_number_is_named_as_such() -> None:
    assert dense_reward({}, 2) == 2.0 and dense_reward({"dense_reward": 1}, float("nan")) == 1.0
    with pytest.raises(ValueError, match="environment: reward is nan: check the environment"):
        dense_reward({}, float("nan"))


def test_a_finished_run_whose_checkpoint_is_damaged_stays_finished(capsys: pytest.CaptureFixture[str]) -> None:
    assert train("--demonstrations", "none", "--steps", "20", "--output", "mine") == 0
    kept = {name: Path("mine", name).read_bytes() for name in ("config.json", "result.json")}
    next(Path("mine/checkpoints").glob("*/state.json")).write_bytes(b"{")
    assert main(["train", "--resume", "mine", "--steps", "20", "--no-progress"]) == 2
    assert "all of its 1 checkpoints are damaged" in capsys.readouterr().err
    assert {name: Path("mine", name).read_bytes() for name in kept} == kept


def test_bringing_a_run_to_its_end_begins_goes_on_or_does_nothing() -> None:
    lines: list[str] = []
    run = Run(env=ENV_ID, algo="td3", preset="small.yml", demonstrations="none", steps=20, output="mine", progress=False)
    assert finish_run(run, lines.append)["timesteps"] == 20
    lines.clear()
    assert finish_run(run, lines.append)["timesteps"] == 20 and lines == []
    longer = Run(**{**run.model_dump(), "n_timesteps": 40})
    assert finish_run(longer, lines.append)["timesteps"] == 40
    assert "40 steps from step 20" in lines[0]
    with pytest.raises(ValueError, match="mine holds another run"):
        finish_run(Run(**{**run.model_dump(), "settings": {"gamma": 0.5}}))


def test_a_stopped_run_gets_the_steps_that_it_is_to_have_now() -> None:
    """As a finished one does; fewer than it began with are none of its own."""
    run = Run(env=ENV_ID, algo="td3", preset="small.yml", demonstrations="none", steps=40, output="mine", progress=False)
    for steps, end in ((60, 60), (80, 80), (20, 80)):
        Path("mine/result.json").unlink(missing_ok=True)
        if steps == 60:
            with pytest.raises(TrainingStopped):
                finish_run(run, callbacks=[StopAt(10)])
        assert finish_run(Run(**{**run.model_dump(), "n_timesteps": steps}))["timesteps"] == end
    assert finish_run(run)["timesteps"] == 80


def test_a_folder_of_another_kept_agent_is_refused() -> None:
    run = Run(env=ENV_ID, algo="td3", preset="small.yml", demonstrations="none", steps=20, output="mine", progress=False)
    assert finish_run(run)["timesteps"] == 20
    with pytest.raises(ValueError, match=r"another run, with keep=last and not best: .*or give the old keep"):
        finish_run(Run(**{**run.model_dump(), "keep": "best"}))


def test_training_ends_at_the_return_that_was_aimed_at_with_the_best_agent() -> None:
    """Every evaluation of the line gives 20; the first is before the training."""
    run = Run(env=ENV_ID, algo="td3", preset="small.yml", demonstrations="none", eval_freq=10, steps=60, progress=False)
    given = {**run.model_dump(exclude_unset=True), "target_return": 19.0, "keep": "best", "output": "mine"}
    assert finish_run(Run(**given))["timesteps"] == 1
    assert finish_run(Run(**given))["timesteps"] == 1  # it is finished
    unreachable = finish_run(Run(**{**given, "target_return": 21.0, "output": "other"}))
    assert unreachable["timesteps"] == 60


def test_tensorboard_gets_the_log_where_the_settings_say_so() -> None:
    pytest.importorskip("tensorboard")
    assert train("--demonstrations", "none", "--steps", "20", "--set", "tensorboard_log=board") == 0
    assert list(Path("board").rglob("events.out.tfevents*"))


def test_without_tensorboard_the_setting_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("stable_baselines3.common.logger.SummaryWriter", None)
    assert train("--demonstrations", "none", "--steps", "20", "--set", "tensorboard_log=board") == 2
    assert "tensorboard_log='board' needs TensorBoard: pip install tensorboard" in capsys.readouterr().err


def test_a_task_that_takes_no_render_mode_is_replayed_without_a_video(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own_task.py").write_text(OWN_TASK, encoding="utf-8")
    command = ["train", "--env", "own_task:Own-v0", "--algo", "td3", "--preset", "small.yml", "--steps", "5", "--no-progress"]
    assert main([*command, "--output", "own"]) == 0
    assert main(["evaluate", "own", "--episodes", "1"]) == 0
    assert "no video: rendering is not available here" in capsys.readouterr().out


MISSING = """
import sys
from sb3_actpc.cli import main

for module, *command in (line.split() for line in sys.argv[1:]):
    sys.modules[module] = None
    assert main(command) == 2
    del sys.modules[module]
"""


def test_the_extra_is_named_where_one_of_its_packages_is_missing() -> None:
    """Before anything is trained."""
    train_one = "train --env Pendulum-v1 --algo td3 --steps 5 --demonstrations none"
    commands = [f"{module} {train_one}" for module in ("pandas", "matplotlib", "tqdm", "rich")]
    commands += [f"{module} compare --envs Pendulum-v1 --algos td3" for module in ("pandas", "rich")]
    commands += [f"{module} report nowhere" for module in ("pandas", "scipy", "matplotlib")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", MISSING, *commands], capture_output=True, text=True, env=environment, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    lines = [line for line in done.stderr.splitlines() if line.startswith("sb3-actpc: error")]
    assert len(lines) == len(commands)
    assert all('pip install "sb3-actpc[experiments]"' in line for line in lines), lines
    assert not Path("runs").exists()
