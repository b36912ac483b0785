"""What a run is, from text to JSON: the same numbers whoever reads them, and mistakes that are named."""

import json
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from sb3_actpc import ActPC, preset
from sb3_actpc.experiments.comparison import plan_runs, read_comparison
from sb3_actpc.experiments.comparison.plan import read_comparison_file
from sb3_actpc.experiments.runs import Run, resolve
from sb3_actpc.experiments.runs.algorithms import load_algorithm
from sb3_actpc.experiments.runs.presets import read_yaml, with_changes
from sb3_actpc.experiments.runs.record import git_state, read_run, write_config
from sb3_actpc.experiments.runs.schema import merged
from sb3_actpc.utils.arguments import check_settings


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("given", [100_000, 1e5, "100000", "1e5"])
@pytest.mark.parametrize("key", ["steps", "n_timesteps"])
def test_a_number_of_steps_is_one_however_it_is_written(given: Any, key: str) -> None:
    assert Run(**{key: given}).n_timesteps == 100_000


def test_numbers_of_a_comparisons_file_are_numbers() -> None:
    """YAML 1.1, and so PyYAML, reads both as text."""
    text = (
        "{envs: [SparseReacher-v5], algos: [{base: actpc, name: slow, settings: {learning_rate: 1e-4}}], seeds: 1, steps: 2e2}"
    )
    Path("c.yml").write_text(text, encoding="utf-8")
    [run] = plan_runs(read_comparison(read_comparison_file(Path("c.yml"))))
    assert (run.settings["learning_rate"], run.n_timesteps) == (1e-4, 200)
    assert read_yaml("[1e-4, 2.5E+3, -1e3, .5e1, 1e, e5, lin_1e-3, '1e5']", "") == [
        1e-4, 2500.0, -1000.0, 5.0, "1e", "e5", "lin_1e-3", "1e5",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"stepz": 1}, "unknown key 'stepz' (did you mean 'steps'?)"),
        ({"eval_freqs": 1}, "did you mean 'eval_freq'?"),
        ({"steps": 0}, "steps=0 must be greater than or equal to 1"),
        ({"steps": 1.5}, "steps=1.5 must be a valid integer"),
        ({"steps": True}, "steps=True must be a number"),
        ({"steps": "many"}, "steps='many' must be a number"),
        ({"seed": -1}, "seed=-1 must be greater"),
        ({"algo": "actpcc"}, "algo='actpcc' is no algorithm (did you mean 'actpc'?)"),
        ({"noise_type": "pink"}, "noise_type='pink' must be 'normal' or 'ornstein-uhlenbeck'"),
        ({"noise_std": float("nan")}, "noise_std=nan must be a finite number"),
        ({"settings": [1]}, "settings=[1] must be a valid dictionary"),
        ({"name": "../up"}, "name='../up' must match pattern"),
        ({"n_envs": 5000}, "n_envs=5000 must be less than or equal to 1024"),
    ],
)
def test_mistakes_are_named_in_one_line(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as caught:
        Run(**given)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("algo", "settings", "message"),
    [
        ("td3", {"batch_size": 0}, "batch_size=0 must be between 1 and"),
        ("td3", {"gamma": None}, "gamma=None must be a finite number"),
        ("td3", {"train_freq": 0}, "train_freq=0 must be a whole number"),
        ("ppo", {"gae_lambda": 2.0}, "gae_lambda=2.0 must be between 0 and 1"),
        ("ppo", {"use_sde": "abc"}, "use_sde='abc' must be True or False"),
    ],
)
def test_settings_of_sb3s_algorithms_are_checked_before_they_run(algo: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        resolve(Run(env="Pendulum-v1", algo=algo, demonstrations="none", n_timesteps=100, settings=settings))


def test_no_limit_is_a_limit() -> None:
    check_settings(load_algorithm("ppo"), {"max_grad_norm": float("inf")})
    run = Run(env="Pendulum-v1", algo="ppo", demonstrations="none", normalize={"clip_reward": float("inf")}, n_timesteps=100)
    assert resolve(run).normalize["clip_reward"] == float("inf")  # type: ignore[index]


def test_a_filled_run_is_the_same_after_its_trip_through_a_file() -> None:
    run = resolve(Run(env="SparseHopper-v5", output="run", settings={"gamma": 0.5}, noise_type=None, seed=3))
    assert run.is_resolved and resolve(run) is run
    write_config(run)
    assert read_run(Path("run")) == run
    assert Run.model_validate_json(run.model_dump_json()) == run


def test_what_is_said_comes_before_the_preset_and_later_before_earlier() -> None:
    shared, task, variant = Run(steps=10, seed=1), Run(env="A", steps=20, env_kwargs={"a": 1}), Run(env_kwargs={"b": 2})
    assert merged(shared, task, variant) == {"n_timesteps": 20, "seed": 1, "env": "A", "env_kwargs": {"a": 1, "b": 2}}
    Path("p.yml").write_text(
        "default: {n_timesteps: 30, gamma: 0.9, tau: 0.1, noise_type: normal, noise_std: 0.2}", encoding="utf-8"
    )
    run = resolve(Run(env="Pendulum-v1", preset="p.yml", steps=5, settings={"tau": 0.2, "noise_type": None}))
    assert (run.n_timesteps, run.settings, run.noise_type) == (5, {"gamma": 0.9, "tau": 0.2}, None)
    assert (run.eval_freq, run.checkpoint_freq) == (1, 1)
    quiet = resolve(Run(env="Pendulum-v1", preset="p.yml", noise_type=None))  # None, where it is said, comes before it too
    assert (quiet.noise_type, quiet.noise_std) == (None, None)


def test_a_dotted_key_changes_one_value_of_a_mapping() -> None:
    settings = {"policy_kwargs": {"n_critics": 2, "net_arch": [8]}}
    assert with_changes(settings, {"policy_kwargs.net_arch": [64, 64], "circuit_kwargs.weight_decay": 0.1}) == {
        "policy_kwargs": {"n_critics": 2, "net_arch": [64, 64]},
        "circuit_kwargs": {"weight_decay": 0.1},
    }
    assert settings["policy_kwargs"]["net_arch"] == [8]  # untouched
    with pytest.raises(ValueError, match=r"gamma.x=1: gamma=0.9 is no mapping"):
        with_changes({"gamma": 0.9}, {"gamma.x": 1})


def test_a_run_folder_of_another_version_is_refused_with_the_reason() -> None:
    Path("old").mkdir()
    record = {"env": "SparseHopper-v5", "env_kwargs": {}, "algo": "actpc", "seed": 0, "overrides": {}}
    Path("old/config.json").write_text(json.dumps(record), encoding="utf-8")
    with pytest.raises(ValueError, match=r"old/config.json has the schema 1, this version reads 2: train the run again"):
        read_run(Path("old"))


def test_a_preset_is_given_to_the_constructor_as_it_is() -> None:
    Path("p.yml").write_text(
        "default: {n_timesteps: 9, noise_type: normal, noise_std: 0.2, learning_rate: lin_4e-4, train_freq: [2, step], "
        "buffer_size: 100}",
        encoding="utf-8",
    )
    keywords = preset("SparseHopper-v5", "p.yml")
    assert {"n_timesteps", "noise_type", "noise_std", "n_envs", "env_kwargs"}.isdisjoint(keywords)
    agent = ActPC(env=gym.make("SparseHopper-v5"), **keywords)
    assert [agent.lr_schedule(left) for left in (1.0, 0.5)] == pytest.approx([4e-4, 2e-4])
    assert agent.action_noise is not None and agent.action_noise().shape == (3,)
    assert agent.train_freq.frequency == 2
    assert agent.demonstrations is not None


def test_a_source_tree_with_changes_is_marked(tmp_path: Path) -> None:
    import subprocess

    def git(*words: str) -> None:
        names = ["-c", "user.name=n", "-c", "user.email=e"]
        subprocess.run(["git", "-C", str(tmp_path), *names, *words], check=True, capture_output=True)

    assert git_state(tmp_path) == (None, None)
    git("init", "-q")
    (tmp_path / "file").write_text("1")
    git("add", "file")
    git("commit", "-qm", "one")
    commit, dirty = git_state(tmp_path)
    assert commit is not None and len(commit) == 40 and dirty is False
    (tmp_path / "file").write_text("2")
    assert git_state(tmp_path) == (commit, True)


def test_a_run_of_a_device_that_is_not_here_is_read_but_not_trained(tmp_path: Path) -> None:
    """It plays on the CPU."""
    write_config(Run(env="SparseReacher-v5", device="abacus", output=str(tmp_path)))
    run = read_run(tmp_path)
    assert run.device == "abacus"
    with pytest.raises(ValueError, match="device='abacus'"):
        resolve(run)
