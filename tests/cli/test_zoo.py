"""rl-zoo3's own scripts, really run: its import changes Gymnasium for the whole process, so they run in another one."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

from sb3_actpc.cli import main as command_line
from sb3_actpc.cli.zoo import NET_ARCHS, _playing_arguments, convert_actpc_params
from sb3_actpc.experiments.runs import Run, resolve
from tests.recordings import record

ROOT = Path(__file__).resolve().parents[2]
FEWER = {"learning_starts": 60, "batch_size": 8, "buffer_size": 500, "policy_kwargs": {"net_arch": [8]}}
NOISE = {"noise_type": "normal", "noise_std": 0.1}
PRESETS: dict[str, dict[str, Any]] = {
    "actpc": {**FEWER, **NOISE, "learning_rate": "lin_1e-3", "n_timesteps": 120},
    "her": {**FEWER, "policy": "MultiInputPolicy", "n_timesteps": 110},
    "logo": {"n_steps": 64, "batch_size": 32, "n_timesteps": 64, "discriminator_net_arch": [8]},
}
ACTPC = ["--algo", "actpc", "--env", "SparseReacher-v5"]
HER = ["--algo", "her", "--env", "GoalReacher-v5"]
LOGO = ["--algo", "logo", "--env", "SparseReacher-v5"]
FEW = ["--demonstrations", "shown.npz", "--num-threads", "1", "--eval-episodes", "1"]
TRAIN = ["--eval-freq", "60", "--seed", "1", *FEW]
OPTIMIZE = ["--n-trials", "2", "--n-startup-trials", "1", "--n-evaluations", "1", "-n", "70", "--pruner", "none", *FEW]
PLAY = ["--no-render", "-n", "60"]
TRAINED = "logs/actpc/SparseReacher-v5_1/SparseReacher-v5.zip"
SCRIPT = {
    "train": ["train", *ACTPC, "--preset", "actpc.yml", "--save-freq", "100", *TRAIN, "-params", "gamma:0.9"],
    "enjoy": ["enjoy", *ACTPC, *PLAY],
    "plot": ["plot", "-a", "actpc", "-e", "SparseReacher-v5", "-f", "logs", "-y", "success", "-w", "1", "--output", "s.png"],
    "continue": ["train", *ACTPC, "--preset", "actpc.yml", *TRAIN, "-i", TRAINED, "-n", "20"],
    "optimize": ["optimize", *ACTPC, "--preset", "actpc.yml", *OPTIMIZE],
    "train her": ["train", *HER, "--preset", "her.yml", *TRAIN],
    "enjoy her": ["enjoy", *HER, *PLAY],
    "optimize her": ["optimize", *HER, "--preset", "her.yml", *OPTIMIZE],
    "train logo": ["train", *LOGO, "--preset", "logo.yml", *TRAIN],
    "enjoy logo": ["enjoy", *LOGO, *PLAY],
}
CODE = """
import json, sys
import rl_zoo3.exp_manager
from sb3_actpc.cli import main

make_vec_env = rl_zoo3.exp_manager.make_vec_env

def make_and_tell(*arguments, **keywords):
    print(f"made with seed {keywords['seed']}")
    return make_vec_env(*arguments, **keywords)

rl_zoo3.exp_manager.make_vec_env = make_and_tell
for name, arguments in json.loads(sys.argv[1]).items():
    print(f"@@@ {name}", flush=True)
    assert main(["--debug", "zoo", *arguments]) == 0
"""


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """The folder in which all commands ran, and what each printed."""
    pytest.importorskip("rl_zoo3")
    folder = tmp_path_factory.mktemp("zoo")
    record("SparseReacher-v5").save(folder / "shown.npz")
    for name, settings in PRESETS.items():
        (folder / f"{name}.yml").write_text(yaml.safe_dump({"default": settings}), encoding="utf-8")
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, "-c", CODE, json.dumps(SCRIPT)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment, timeout=600, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    parts = done.stdout.split("@@@ ")[1:]
    return folder, dict(part.split("\n", 1) for part in parts)


def settings_in(path: Path) -> dict[str, Any]:
    class Reader(yaml.SafeLoader):
        """Reads an OrderedDict as the list of pairs that it is made of."""

    Reader.add_constructor(
        "tag:yaml.org,2002:python/object/apply:collections.OrderedDict",
        lambda loader, node: dict(loader.construct_sequence(node, deep=True)[0]),
    )
    return yaml.load(path.read_text(encoding="utf-8"), Loader=Reader)


def test_training_writes_what_rl_zoo3_writes(ran: tuple[Path, dict[str, str]]) -> None:
    run = ran[0] / "logs" / "actpc" / "SparseReacher-v5_1"
    names = {path.name for path in run.iterdir()}
    assert {"SparseReacher-v5.zip", "best_model.zip", "evaluations.npz", "0.monitor.csv", "rl_model_100_steps.zip"} <= names
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [60, 120]


def test_our_settings_and_demonstrations_reach_the_agent_and_can_be_replaced(ran: tuple[Path, dict[str, str]]) -> None:
    settings = settings_in(ran[0] / "logs" / "actpc" / "SparseReacher-v5_1" / "SparseReacher-v5" / "config.yml")
    assert settings["demonstrations"] == str(ran[0] / "shown.npz")
    assert settings["gamma"] == 0.9
    assert settings["learning_rate"] == "lin_1e-3"


def test_the_success_rate_is_logged_and_plotted(ran: tuple[Path, dict[str, str]]) -> None:
    folder, printed = ran
    header = (folder / "logs" / "actpc" / "SparseReacher-v5_1" / "0.monitor.csv").read_text(encoding="utf-8").splitlines()[1]
    assert "is_success" in header
    assert "No data" not in printed["plot"]
    assert (folder / "s.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("command", ["enjoy", "enjoy her", "enjoy logo"])
def test_trained_agents_are_played(ran: tuple[Path, dict[str, str]], command: str) -> None:
    """Without their environment, with a learning rate of 0, and with rl-zoo3's other replacements."""
    assert "Episode Length 50" in ran[1][command]
    assert "Success rate" in ran[1][command]


def test_the_evaluation_starts_elsewhere_than_the_training(ran: tuple[Path, dict[str, str]]) -> None:
    seeds = [int(line.rpartition(" ")[2]) for line in ran[1]["train"].splitlines() if line.startswith("made with seed")]
    assert sorted(seeds) == [1, 1_000_001]


def test_help_is_rl_zoo3s_with_our_algorithms() -> None:
    pytest.importorskip("rl_zoo3")
    command = [sys.executable, "-m", "sb3_actpc", "zoo", "train", "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120, check=True).stdout
    assert "--optimize-hyperparameters" in shown and "actpc" in shown and "logo" in shown


def test_a_continued_run_does_not_begin_with_random_actions_again(ran: tuple[Path, dict[str, str]]) -> None:
    settings = settings_in(ran[0] / "logs" / "actpc" / "SparseReacher-v5_2" / "SparseReacher-v5" / "config.yml")
    assert settings["learning_starts"] == 0
    assert "Loading pretrained agent" in ran[1]["continue"]


@pytest.mark.parametrize("algo", ["actpc", "her"])
def test_a_search_tries_settings_and_keeps_them_in_a_journal(ran: tuple[Path, dict[str, str]], algo: str) -> None:
    folder, printed = ran
    text = printed["optimize" if algo == "actpc" else "optimize her"]
    assert "Number of finished trials:  2" in text
    assert "learning_rate: " in text
    assert len(list((folder / "logs" / algo).glob("*.log"))) == 1
    (report,) = (folder / "logs" / algo).glob("report_*.csv")
    states = report.read_text(encoding="utf-8")
    assert states.count("COMPLETE") == 2  # none was pruned by an error


@pytest.mark.parametrize("algo", ["actpc", "her"])
def test_the_best_trial_of_a_search_is_a_preset(ran: tuple[Path, dict[str, str]], algo: str) -> None:
    env_id = {"actpc": "SparseReacher-v5", "her": "GoalReacher-v5"}[algo]
    folder = ran[0] / "logs" / algo
    (report,) = folder.glob("report_*.csv")
    trials = pd.read_csv(report)
    best = trials.loc[trials["value"].idxmax()]
    preset = folder / f"{algo}_{env_id}.yml"
    run = resolve(Run(env=env_id, algo=algo, preset=str(preset), demonstrations="none"))
    assert run.settings["learning_rate"] == pytest.approx(best["params_learning_rate"])  # not the file's, which is another
    assert run.settings["gamma"] == pytest.approx(1.0 - best["params_one_minus_gamma"])
    assert run.settings["buffer_size"] == FEWER["buffer_size"] and run.n_timesteps == PRESETS[algo]["n_timesteps"]
    assert run.settings.get("actor_kwargs") is None  # it has the sampled rate
    assert f"--preset {preset.relative_to(ran[0])}" in ran[1]["optimize" if algo == "actpc" else "optimize her"]


def test_sampled_parameters_become_keywords() -> None:
    sampled = {
        **dict.fromkeys(("learning_rate", "tau", "critic_weight", "refresh_weight", "alpha_ep", "alpha_in"), 0.5),
        "one_minus_gamma": 0.01,
        "batch_size_pow": 7,
        "net_arch": "small",
        "weight_decay": 0.3,
    }
    params = convert_actpc_params(sampled)
    assert (params["gamma"], params["batch_size"]) == (0.99, 128)
    circuits = {"circuit_kwargs": {"weight_decay": 0.3}}
    assert params["policy_kwargs"] == {"net_arch": NET_ARCHS["small"], **circuits}
    assert params["critic_weight"] == 0.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--algo", "actpc"], "--env is missing"),
        (["optimize", "--algo", "bc", "--env", "SparseReacher-v5"], "zoo optimize does not know what to vary for 'bc'"),
        (["enjoy", "--env", "SparseReacher-v5", "--folder", "nowhere"], "no runs of actpc in nowhere"),
        (["enjoy", "--env", "Mine-v0"], "name that: MODULE:Mine-v0, or --gym-packages MODULE"),
        (["train", "--env", "SparseReacher-v5", "--demonstrations", "no.npz"], "no demonstrations file at no.npz"),
        (["train", "--env", "SparseReacher-v5", "-conf", "c.yml", "--demonstrations", "none"], "--demonstrations none is for"),
        (["optimize", "--env", "SparseReacher-v5", "-conf", "c.yml", "--preset", "td3"], "--preset td3 is for presets, and"),
    ],
)
def test_mistakes_give_one_line_and_exit_code_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_actpc.cli.zoo.register_algorithms", lambda: None)  # leaves rl-zoo3 alone
    assert command_line(["zoo", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_modules_of_ones_own_are_found_in_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_tasks_of_zoo.py").write_text("import gymnasium\ngymnasium.register('MineOfZoo-v0', 'nowhere:Env')\n")
    (tmp_path / "logs" / "actpc").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    arguments = ["--env", "MineOfZoo-v0", "--gym-packages", "my_tasks_of_zoo", "--no-render"]
    passed = _playing_arguments(arguments)
    assert passed[:2] == ["--gym-packages", "my_tasks_of_zoo"] and passed[-1] == "--no-render"


def test_without_rl_zoo3_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    with pytest.raises(ImportError, match=r"sb3-actpc\[zoo\]"):
        command_line(["--debug", "zoo", "train", "--env", "SparseReacher-v5"])
