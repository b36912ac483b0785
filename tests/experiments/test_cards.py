"""Model repositories of runs, and the agents that are bundled from them."""

import json
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import yaml

from sb3_actpc import ActPC
from sb3_actpc.cli import main
from sb3_actpc.experiments.cards import bundle_agent
from sb3_actpc.experiments.runs import Run, resolve, train_run
from sb3_actpc.experiments.runs.record import read_run
from sb3_actpc.pretrained import load_pretrained, read_index

ENV_ID = "SparseReacher-v5"


class WithoutRewards(gym.Wrapper):
    """A task with goals that cannot say what another goal would have paid."""

    def get_wrapper_attr(self, name: str) -> Any:
        if name == "compute_reward":
            raise AttributeError(name)
        return super().get_wrapper_attr(name)


SETTINGS: dict[str, Any] = {
    "guidance_kwargs": {"bc_updates": 20, "critic_warmup": 0},
    "policy_kwargs": {"net_arch": [16, 16]},
}


def trained(folder: Path, seed: int = 0, **options: Any) -> Path:
    """The folder of a short run."""
    given = {"env": ENV_ID, "n_timesteps": 20, "eval_episodes": 2, "checkpoint_freq": 0, "settings": SETTINGS, **options}
    train_run(Run(**given, seed=seed, progress=False, output=str(folder)))
    return folder


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(tmp_path_factory.mktemp("runs") / "run")


def test_a_card_holds_what_the_hub_asks_for_and_how_to_use_and_train_the_agent(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["card", str(run_folder), "--output", str(tmp_path / "card"), "--episodes", "2", "--no-video"]) == 0
    monkeypatch.chdir(tmp_path / "card")
    model = f"actpc-{ENV_ID}"
    files = {"README.md", "config.json", "preset.yml", "results.json", f"{model}.zip", f"{model}.safetensors"}
    assert {path.name for path in Path(".").iterdir()} == files
    text = Path("README.md").read_text(encoding="utf-8")
    metadata = yaml.safe_load(text.split("---\n")[1])
    [entry] = metadata["model-index"]
    [result] = entry["results"]
    assert (entry["name"], result["dataset"]["type"], metadata["library_name"]) == ("actpc", ENV_ID, "stable-baselines3")
    results = json.loads(Path("results.json").read_text(encoding="utf-8"))
    [metric] = result["metrics"]
    assert metric["value"] == f"{results['mean_reward']:.2f} +/- {results['std_reward']:.2f}"
    assert results["n_eval_episodes"] == 2
    [code] = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    assert isinstance(names["model"], ActPC)
    assert f"sb3-actpc train --algo actpc --env {ENV_ID} --steps 20 --seed 0 --preset preset.yml" in text
    again, before = resolve(Run(env=ENV_ID, preset="preset.yml")), read_run(run_folder)
    for name in ("settings", "n_timesteps", "policy", "n_envs", "env_kwargs", "normalize", "noise_type"):
        assert getattr(again, name) == getattr(before, name)
    assert again.settings["policy_kwargs"] == {"net_arch": [16, 16]}


def test_an_agent_with_hindsight_is_played_without_an_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = {"env": "GoalReacher-v5", "demonstrations": "none", "gym_packages": ("sb3_actpc",), "policy": "MultiInputPolicy"}
    settings = {"replay_buffer_class": "HerReplayBuffer", "learning_starts": 10, "policy_kwargs": {"net_arch": [16]}}
    run = trained(tmp_path / "run", settings=settings, **task)
    assert main(["card", str(run), "--output", str(tmp_path / "card"), "--episodes", "1", "--no-video"]) == 0
    monkeypatch.chdir(tmp_path / "card")
    text = Path("README.md").read_text(encoding="utf-8")
    assert "--gym-packages sb3_actpc" in text
    agent = ActPC.load("actpc-GoalReacher-v5.zip")
    with pytest.raises(ValueError, match=r"HerReplayBuffer.* needs a goal environment with compute_reward"):
        agent.set_env(WithoutRewards(gym.make("GoalReacher-v5")))
    agent.set_env(gym.make("GoalReacher-v5"))
    assert agent.learn(60, reset_num_timesteps=False).num_timesteps == 80


def test_a_folder_with_files_is_not_written_over(run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "note.txt").write_text("mine", encoding="utf-8")
    assert main(["card", str(run_folder), "--output", str(tmp_path), "--no-video"]) == 2
    assert "choose an empty folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["note.txt"]


def test_an_agent_is_bundled_in_the_place_of_the_one_of_its_task(run_folder: Path, tmp_path: Path) -> None:
    for _ in range(2):
        path = bundle_agent(run_folder, tmp_path / "agents")
        [(env_id, row)] = read_index(tmp_path / "agents").items()
        assert (env_id, row["seed"], row["timesteps"], row["file"]) == (ENV_ID, 0, 20, path.name)
    assert load_pretrained(ENV_ID, folder=tmp_path / "agents").policy.net_arch == [16, 16]
    td3 = trained(tmp_path / "td3", algo="td3", settings={"learning_starts": 5, "policy_kwargs": {"net_arch": [8]}})
    with pytest.raises(ValueError, match="holds td3: only runs of actpc"):
        bundle_agent(td3, tmp_path / "agents")
