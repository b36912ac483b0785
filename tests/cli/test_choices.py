"""What a user may choose on the command line: steps, settings, own environments, more steps, TensorBoard."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import TD3

import sb3_actpc
from sb3_actpc.checkpoints import TrainingStopped
from sb3_actpc.cli import main
from sb3_actpc.demonstrations import Demonstrations
from sb3_actpc.experiments.runs import Run, finish_run
from tests.checkpoints.runs import Terminate
from tests.cli.line import ENV_ID, rows_of, train
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
    assert sb3_actpc.ActPC.load("mine/model.zip", env=gym.make(ENV_ID)).demonstrations == "line/still-v0"
    resume = ["train", "--resume", "mine", "--steps", "10", "--no-progress"]
    assert main(resume) == 0
    shutil.rmtree("sets")
    write_minari(shown.select(1), "line/still-v0", gym.make(ENV_ID))  # another set under the same name
    assert main(resume) == 2
    assert "the demonstrations (line/still-v0) are not those that the run began with" in capsys.readouterr().err


OWN_ALGORITHMS = """
import sb3_actpc
import stable_baselines3

class OwnTD3(stable_baselines3.TD3):
    pass

class OwnActPC(sb3_actpc.ActPC):
    pass
"""


def test_an_algorithm_and_a_task_of_the_working_folder_are_trained_replayed_and_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Observations of two parts, one reward, no rendering. The worker of the comparison, another process, finds them too."""
    (tmp_path / "own_algorithms.py").write_text(OWN_ALGORITHMS, encoding="utf-8")
    (tmp_path / "own_task.py").write_text(OWN_TASK, encoding="utf-8")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(tmp_path))])
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    quick = ["--steps", "20", "--eval-episodes", "1", "--no-progress"]
    own = ["--algo", "own_algorithms:OwnTD3", "--env", "Own-v0", "--gym-packages", "own_task", "--preset", "small.yml"]
    assert main(["train", *own, *quick]) == 0
    record = json.loads(Path("runs/Own-v0/OwnTD3_small_seed0/config.json").read_text(encoding="utf-8"))
    assert (record["policy"], record["gym_packages"]) == ("MultiInputPolicy", ["own_task"])
    assert main(["evaluate", "runs/Own-v0/OwnTD3_small_seed0", "--episodes", "1"]) == 0
    printed = capsys.readouterr().out
    assert "step       20  return       5.0" in printed and "\nreturn  " in printed and "dense" not in printed
    assert "no video: rendering is not available here" in printed
    algos = {"preset": "small.yml", "algo": "own_algorithms:OwnTD3"}
    Path("c.yml").write_text(json.dumps({"envs": ["own_task:Own-v0"], "algos": [algos], "seeds": 1}), encoding="utf-8")
    assert main(["compare", "c.yml", *quick, "--workers", "1"]) == 0
    assert "1 of 1 runs are finished" in capsys.readouterr().out
    assert len(list(Path("runs/comparison/own_task_Own-v0/OwnTD3").glob("*/result.json"))) == 1
    assert main(["compare", "--envs", "SparseReacher-v5", "--algos", "own_algorithms:OwnActPC", "--dry-run"]) == 0


def test_a_finished_run_is_given_more_steps(capsys: pytest.CaptureFixture[str]) -> None:
    """It ends as one that was to have them from the beginning, its evaluations at the former end apart."""
    straight = ["--eval-freq", "20", "--steps", "60", "--output", "straight"]
    assert train(*straight) == 0
    assert train(*[{"60": "40", "straight": "more"}.get(word, word) for word in straight]) == 0
    assert main(["train", "--resume", "more", "--no-progress"]) == 2
    assert "is finished: give it more steps with --steps N" in capsys.readouterr().err
    assert main(["train", "--resume", "more", "--steps", "many"]) == 2
    assert "steps='many' must be a number" in capsys.readouterr().err
    assert main(["train", "--resume", "more", "--steps", "2e1", "--no-progress"]) == 0
    assert "60 steps from step 40" in capsys.readouterr().out
    assert [int(row["timesteps"]) for row in rows_of("more")] == [0, 20, 40, 60]
    assert json.loads(Path("more/result.json").read_text(encoding="utf-8"))["timesteps"] == 60
    weights = [TD3.load(f"{name}/model.zip").policy.state_dict() for name in ("straight", "more")]
    assert all(bool((value == weights[1][name]).all()) for name, value in weights[0].items())
    assert len(list(Path("more/checkpoints").iterdir())) == 1


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
    assert train("--steps", "20", "--set", "tensorboard_log=board") == 0
    assert list(Path("board").rglob("events.out.tfevents*"))


def test_a_run_without_a_checkpoint_cannot_go_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert train("--steps", "20", "--checkpoint-freq", "0", "--output", "mine") == 0
    assert main(["train", "--resume", "mine", "--steps", "20"]) == 2
    assert "mine has no checkpoint to go on from (td3 left none)" in capsys.readouterr().err


def test_bringing_a_run_to_its_end_begins_goes_on_or_does_nothing() -> None:
    """A stopped run and a finished one get the steps that they are to have now; fewer than before are none of their own."""
    lines: list[str] = []
    run = Run(env=ENV_ID, algo="td3", preset="small.yml", demonstrations="none", steps=40, output="mine", progress=False)
    with pytest.raises(TrainingStopped):
        finish_run(run, callbacks=[Terminate(10)])
    for steps, end in ((60, 60), (80, 80), (20, 80)):
        lines.clear()
        assert finish_run(Run(**{**run.model_dump(), "n_timesteps": steps}), lines.append)["timesteps"] == end
    assert lines == []
    for changed, difference in (
        ({"settings": {"gamma": 0.5}}, "gamma=unset and not 0.5"),
        ({"settings": {"replay_buffer_kwargs": None}}, "replay_buffer_kwargs=unset and not None"),
        ({"keep": "best"}, "keep=last and not best"),
    ):
        with pytest.raises(ValueError, match=f"mine holds another run, with {difference}"):
            finish_run(Run(**{**run.model_dump(), **changed}))


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
    commands += ["tqdm compare --envs Pendulum-v1 --algos td3"]
    commands += [f"{module} report nowhere" for module in ("pandas", "scipy", "matplotlib")]
    line = [sys.executable, "-c", MISSING, *commands]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(line, capture_output=True, text=True, env=environment, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    lines = [line for line in done.stderr.splitlines() if line.startswith("sb3-actpc: error")]
    assert len(lines) == len(commands)
    assert all('pip install "sb3-actpc[experiments]"' in line for line in lines), lines
    assert not list(Path("runs").rglob("config.json"))
