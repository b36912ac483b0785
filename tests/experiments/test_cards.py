"""Model repositories of runs, and the agents that are bundled from them."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from sb3_actpc import ActPC
from sb3_actpc.cli import main
from sb3_actpc.experiments.cards import bundle_agents
from sb3_actpc.experiments.runs import Run, resolve, train_run, video
from sb3_actpc.experiments.runs.record import read_run
from sb3_actpc.pretrained import load_pretrained, read_index

ENV_ID = "SparseReacher-v5"
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


def test_a_card_holds_what_the_hub_asks_for(run_folder: Path, tmp_path: Path) -> None:
    assert main(["card", str(run_folder), "--output", str(tmp_path / "card"), "--episodes", "2", "--no-video"]) == 0
    written = {path.name for path in (tmp_path / "card").iterdir()}
    model = f"actpc-{ENV_ID}"
    assert written == {"README.md", "config.json", "preset.yml", "results.json", f"{model}.zip", f"{model}.safetensors"}
    metadata = yaml.safe_load((tmp_path / "card" / "README.md").read_text(encoding="utf-8").split("---\n")[1])
    [entry] = metadata["model-index"]
    [result] = entry["results"]
    assert (entry["name"], result["dataset"]["type"], metadata["library_name"]) == ("actpc", ENV_ID, "stable-baselines3")
    results = json.loads((tmp_path / "card" / "results.json").read_text(encoding="utf-8"))
    [metric] = result["metrics"]
    assert metric["value"] == f"{results['mean_reward']:.2f} +/- {results['std_reward']:.2f}"
    assert results["n_eval_episodes"] == 2


def test_the_command_of_a_card_trains_with_the_settings_of_the_run(run_folder: Path, tmp_path: Path) -> None:
    assert main(["card", str(run_folder), "--output", str(tmp_path / "card"), "--episodes", "1", "--no-video"]) == 0
    text = (tmp_path / "card" / "README.md").read_text(encoding="utf-8")
    assert f"sb3-actpc train --algo actpc --env {ENV_ID} --steps 20 --seed 0 --preset preset.yml" in text
    again = resolve(Run(env=ENV_ID, preset=str(tmp_path / "card" / "preset.yml")))
    before = read_run(run_folder)
    for name in ("settings", "n_timesteps", "policy", "n_envs", "env_kwargs", "normalize", "noise_type"):
        assert getattr(again, name) == getattr(before, name)
    assert again.settings["policy_kwargs"] == {"net_arch": [16, 16]}


def test_the_code_of_a_card_loads_its_files(run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert main(["card", str(run_folder), "--output", str(tmp_path / "card"), "--episodes", "1", "--no-video"]) == 0
    monkeypatch.chdir(tmp_path / "card")
    [code] = re.findall(r"```python\n(.*?)```", Path("README.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    assert isinstance(names["model"], ActPC)


def test_a_card_has_a_video_where_the_machine_can_render(run_folder: Path, tmp_path: Path) -> None:
    if video.choose_gl_backend() is None:
        pytest.skip("this machine cannot render")
    assert main(["card", str(run_folder), "--output", str(tmp_path / "card"), "--episodes", "1"]) == 0
    assert (tmp_path / "card" / "replay.mp4").stat().st_size > 0
    assert "replay.mp4" in (tmp_path / "card" / "README.md").read_text(encoding="utf-8")


def test_a_folder_with_files_is_not_written_over(run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "note.txt").write_text("mine", encoding="utf-8")
    assert main(["card", str(run_folder), "--output", str(tmp_path), "--no-video"]) == 2
    assert "choose an empty folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["note.txt"]


def test_the_agent_with_the_median_return_is_bundled(run_folder: Path, tmp_path: Path) -> None:
    runs = []
    for seed, value in enumerate((3.0, 1.0, 2.0)):
        folder = tmp_path / f"run{seed}"
        folder.mkdir()
        for name in ("config.json", "model.zip", "result.json"):
            (folder / name).write_bytes((run_folder / name).read_bytes())
        result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        (folder / "result.json").write_text(json.dumps({**result, "return": value, "seed": seed}), encoding="utf-8")
        runs.append(folder)
    [path] = bundle_agents(runs, tmp_path / "agents")
    row = read_index(tmp_path / "agents")[ENV_ID]
    assert (row["return"], row["seed"], row["file"]) == (2.0, 2, path.name)
    assert load_pretrained(ENV_ID, folder=tmp_path / "agents").policy.net_arch == [16, 16]


def test_another_algorithm_is_not_bundled(tmp_path: Path) -> None:
    folder = trained(tmp_path / "td3", algo="td3", settings={"learning_starts": 5, "policy_kwargs": {"net_arch": [8]}})
    with pytest.raises(ValueError, match="holds td3: only runs of actpc"):
        bundle_agents([folder], tmp_path / "agents")
