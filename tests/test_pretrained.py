"""Agents that come with the package: they act as the run's deployed policy did, and their files are what the index says."""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from sb3_actpc import ActPC, shipped_demonstrations
from sb3_actpc.cli import main
from sb3_actpc.demonstrations import Demonstrations
from sb3_actpc.experiments.runs import video
from sb3_actpc.pretrained import AGENTS, LARGEST_FILE, load_agent, load_pretrained, read_index, save_agent

ENV_ID = "SparseReacher-v5"


@pytest.fixture(scope="module")
def trained() -> ActPC:
    """An agent with a deployment gate, whose deployed policy and actor differ."""
    guidance = {"bc_updates": 50, "critic_warmup": 0}
    model = ActPC("MlpPolicy", ENV_ID, demonstrations=shipped_demonstrations(ENV_ID), guidance_kwargs=guidance, seed=0)
    return model.learn(20)


@pytest.fixture
def observations() -> np.ndarray:
    """Demonstrated ones, (100, 10)."""
    return Demonstrations.load(shipped_demonstrations(ENV_ID)).observations[:100]


def test_a_saved_agent_acts_as_the_deployed_policy(trained: ActPC, observations: np.ndarray, tmp_path: Path) -> None:
    loaded = load_agent(save_agent(trained, tmp_path / "agent.safetensors"), ENV_ID)
    expected, _ = trained.predict(observations, deterministic=True)
    assert np.array_equal(loaded.predict(observations, deterministic=True)[0], expected)
    assert loaded.gamma == trained.gamma


def test_an_agent_of_other_spaces_and_a_file_of_another_kind_are_refused(trained: ActPC, tmp_path: Path) -> None:
    path = save_agent(trained, tmp_path / "agent.safetensors")
    with pytest.raises(ValueError, match="was trained with observation_space="):
        load_agent(path, "Pendulum-v1")
    path.write_bytes(b"no agent")
    with pytest.raises(ValueError, match=r"agent\.safetensors: not a file of save_agent"):
        load_agent(path, ENV_ID)


def test_an_agent_that_is_too_large_is_not_written(tmp_path: Path) -> None:
    large = ActPC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [512, 512]}, buffer_size=100)
    with pytest.raises(ValueError, match=f"at most {LARGEST_FILE}"):
        save_agent(large, tmp_path / "agent.safetensors")
    assert not list(tmp_path.iterdir())


def test_a_damaged_agent_is_named(tmp_path: Path) -> None:
    row = read_index()[ENV_ID]
    (tmp_path / "index.json").write_text(json.dumps({ENV_ID: row}), encoding="utf-8")
    (tmp_path / row["file"]).write_bytes((AGENTS / row["file"]).read_bytes()[:-1] + b"x")
    with pytest.raises(ValueError, match="not the file that"):
        load_pretrained(ENV_ID, folder=tmp_path)


@pytest.mark.parametrize("env_id", sorted(read_index()))
def test_every_bundled_agent_is_small_and_acts(env_id: str) -> None:
    row = read_index()[env_id]
    assert (AGENTS / row["file"]).stat().st_size <= LARGEST_FILE
    try:
        env = gym.make(env_id, **row["env_kwargs"])
    except ImportError as error:
        pytest.skip(str(error))
    with env:
        action, _ = load_pretrained(env_id, env).predict(env.reset(seed=0)[0], deterministic=True)
        assert env.action_space.contains(action)


def test_every_agent_file_is_in_the_index() -> None:
    assert {path.name for path in AGENTS.glob("*.safetensors")} == {row["file"] for row in read_index().values()}


def test_enjoy_plays_an_agent_and_writes_a_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if video.choose_gl_backend() is None:
        pytest.skip("this machine cannot render")
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["enjoy", "--env", ENV_ID, "--episodes", "2"]) == 0
    assert capsys.readouterr().out.count("episode ") == 2
    assert Path(f"{ENV_ID}.mp4").stat().st_size > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--env", "Pendulum-v1"], "no agent is bundled for 'Pendulum-v1'"),
        (["--env", ENV_ID, "--video", "x.txt"], "must end in .mp4"),
    ],
)
def test_what_cannot_be_played_is_said_in_one_line(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["enjoy", *options]) == 2
    assert message in capsys.readouterr().err


def test_a_bundled_agent_neither_learns_nor_takes_keywords_for_it():
    with pytest.raises(ValueError, match="comes without its critic and only acts"):
        load_pretrained(ENV_ID).learn(100)
    with pytest.raises(ValueError, match="train a new agent"):
        load_pretrained(ENV_ID, guidance="default")
