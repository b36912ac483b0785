"""rl-zoo3's own scripts, really run: its import changes Gymnasium for the whole process, so they run in another one."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sb3_actpc.cli import main as command_line
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
SCRIPT = {
    "train": ["train", *ACTPC, "--preset", "actpc.yml", "--save-freq", "100", *TRAIN, "-params", "gamma:0.9"],
    "enjoy": ["enjoy", *ACTPC, *PLAY],
    "plot": ["plot", "-a", "actpc", "-e", "SparseReacher-v5", "-f", "logs", "-y", "success", "-w", "1", "--output", "s.png"],
    "optimize": ["optimize", *ACTPC, "--preset", "actpc.yml", *OPTIMIZE],
    "train her": ["train", *HER, "--preset", "her.yml", *TRAIN],
    "enjoy her": ["enjoy", *HER, *PLAY],
    "train logo": ["train", *LOGO, "--preset", "logo.yml", *TRAIN],
    "enjoy logo": ["enjoy", *LOGO, *PLAY],
}
MISTAKES = {
    "train --algo actpc": "--env is missing",
    "optimize --algo td3 --env SparseReacher-v5": "zoo optimize does not know what to vary for 'td3'",
    "enjoy --env SparseReacher-v5 --preset td3": "--preset and --demonstrations are for training",
    "enjoy --env Mine-v0": "give MODULE:Mine-v0",
    "train --env SparseReacher-v5 SparseHopper-v5": "zoo train takes one environment",
    "train --env SparseReacher-v5 --demonstrations no.npz": "no demonstrations file at no.npz",
    "train --env SparseReacher-v5 -conf c.yml --demonstrations none": "without --conf-file",
    "optimize --env SparseReacher-v5 -conf c.yml --preset td3": "without --conf-file",
    "train --env SparseReacher-v5 -conf twice.yml": "(line 2: the key 'gamma' is given twice)",
}
CODE = """
import contextlib, json, sys
from sb3_actpc.cli import main

for name, arguments in json.loads(sys.argv[1]).items():
    print(f"@@@ {name}", flush=True)
    with contextlib.redirect_stderr(sys.stdout if name == " ".join(arguments) else sys.stderr):
        print("exit code", main(["zoo", *arguments]), flush=True)
"""


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """The folder in which all commands ran, and what each printed."""
    pytest.importorskip("rl_zoo3")
    folder = tmp_path_factory.mktemp("zoo")
    record("SparseReacher-v5").save(folder / "shown.npz")
    for name, settings in PRESETS.items():
        (folder / f"{name}.yml").write_text(yaml.safe_dump({"default": settings}), encoding="utf-8")
    (folder / "twice.yml").write_text("default: {gamma: 0.9,\n  gamma: 0.8}", encoding="utf-8")
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, "-c", CODE, json.dumps(SCRIPT | {text: text.split() for text in MISTAKES})]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment, timeout=600, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    parts = done.stdout.split("@@@ ")[1:]
    printed = dict(part.split("\n", 1) for part in parts)
    assert all(printed[name].endswith("exit code 0\n") for name in SCRIPT), done.stdout[-2000:] + done.stderr[-4000:]
    return folder, printed


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


def test_a_search_tries_settings(ran: tuple[Path, dict[str, str]]) -> None:
    folder, printed = ran
    assert "Number of finished trials:  2" in printed["optimize"]
    assert "learning_rate: " in printed["optimize"]
    (report,) = (folder / "logs" / "actpc").glob("report_*.csv")
    assert report.read_text(encoding="utf-8").count("COMPLETE") == 2  # none was pruned by an error


@pytest.mark.parametrize("arguments", MISTAKES)
def test_mistakes_give_one_line_and_exit_code_2(ran: tuple[Path, dict[str, str]], arguments: str) -> None:
    code, *printed = ran[1][arguments].splitlines()[::-1]
    assert code == "exit code 2" and MISTAKES[arguments] in printed[0]


def test_without_rl_zoo3_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    with pytest.raises(ImportError, match=r"sb3-actpc\[zoo\]"):
        command_line(["--debug", "zoo", "train", "--env", "SparseReacher-v5"])
