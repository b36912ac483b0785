"""Every entry of every settings file builds its agent on its environment, and the agent trains."""

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
import yaml

from sb3_actpc.baselines.offline.served import ServedAlgorithm
from sb3_actpc.envs import ROBOSUITE_IDS, register_envs, sparse_env_id
from sb3_actpc.experiments.runs import ALGORITHMS, RunConfig
from sb3_actpc.experiments.runs.config import HYPERPARAMS_FOLDERS, resolve_run
from sb3_actpc.experiments.runs.environments import make_train_env, register_tasks
from sb3_actpc.experiments.runs.run import build_model
from tests.recordings import record_file

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date.*", "ignore:.*infinity.*", "ignore:.*mini-batch size.*")
FOLDER = next(folder for folder in HYPERPARAMS_FOLDERS if folder.is_dir())
# settings of a preset that is no algorithm's, and files that hold other things
ALGO_OF = {"actpc_paper": "actpc"}
OTHER_FILES = {"experts"}
N_EPISODES = 26  # of 12 steps: the paper's preset asks for 300 transitions
DEFAULT_ENV = {"her": "GoalHopper-v5", "ppo": "Hopper-v5"}
# what would take long, and nothing else
OFF_POLICY = {"learning_starts": 0, "buffer_size": 1000, "batch_size": 8}
FEWER: dict[str, dict[str, Any]] = {
    **{served: {} for served in ("bcq", "cql", "hbc", "iris")},
    "actpc": {**OFF_POLICY, "prior_updates": 2, "actor_warm_start": 2, "critic_warmup": 0},
    "her": {**OFF_POLICY, "demonstration_fraction": 1.0},
    "bc": {"batch_size": 8},
    "bc_rnn": {"batch_size": 8},
    "td3": OFF_POLICY,
    "ddpg": OFF_POLICY,
    "sac_rlpd": OFF_POLICY,
    "logo": {"n_steps": 16, "batch_size": 8, "n_critic_updates": 1},
    "ppo": {"n_steps": 16, "batch_size": 8, "n_epochs": 1},
}


def entries() -> list[tuple[str, str]]:
    """(preset, key) of every entry."""
    presets = sorted(path for path in FOLDER.glob("*.yml") if path.stem not in OTHER_FILES)
    return [(path.stem, key) for path in presets for key in yaml.safe_load(path.read_text(encoding="utf-8"))]


def values(node: object) -> list[object]:
    """The scalars of nested mappings and lists."""
    if isinstance(node, dict):
        return [value for part in node.values() for value in values(part)]
    return [value for part in node for value in values(part)] if isinstance(node, list) else [node]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the demonstrations of each task are, recorded once."""
    return tmp_path_factory.mktemp("recordings")


@pytest.mark.parametrize(("preset", "key"), entries())
def test_every_entry_builds_its_agent_which_trains(
    preset: str, key: str, recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # d3rlpy and robomimic are not installed here: a slow test of test_served.py trains with the defaults where they are
    monkeypatch.setattr("sb3_actpc.baselines.offline.served.environment_python", lambda package: sys.executable)
    algo = ALGO_OF.get(preset, preset)
    env_id = DEFAULT_ENV.get(algo, "SparseHopper-v5") if key == "default" else key
    register_tasks(env_id)
    if env_id not in gym.registry:
        pytest.skip(f"{env_id} is not registered")
    if env_id in ROBOSUITE_IDS:
        pytest.importorskip("robosuite", reason="robosuite is an extra")
    sparse = sparse_env_id(env_id)
    demonstrations = str(record_file(recordings, sparse, N_EPISODES)) if sparse.startswith("Sparse") else "none"
    n_steps = 16 if algo in ("logo", "ppo") else 3
    overrides = dict(FEWER[algo])
    if algo in ("her", "actpc") and demonstrations == "none":  # nothing to learn from but an episode of its own
        overrides["learning_starts"], n_steps = 50, 52
    config = RunConfig(env_id, algo, preset, demonstrations=demonstrations, overrides=overrides)
    plan = resolve_run(config)
    env = make_train_env(env_id, plan.env_kwargs, plan.n_envs, 0, plan.normalize)
    try:
        model = build_model(plan, config, env)
        if isinstance(model, ServedAlgorithm):
            return
        before = [parameter.clone() for parameter in model.policy.parameters()]
        model.learn(n_steps)
        assert model._n_updates > 0
        after = list(model.policy.parameters())
        assert all(bool(th.isfinite(parameter).all()) for parameter in after)
        assert not all(th.equal(*pair) for pair in zip(before, after, strict=True))
    finally:
        env.close()


def test_every_algorithm_has_settings_with_a_default() -> None:
    found = entries()
    assert {(algo, "default") for algo in ALGORITHMS} <= set(found)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.yml")), ids=lambda path: path.stem)
def test_settings_are_plain_values(path: Path) -> None:
    """No text that some reader would evaluate."""
    for value in values(yaml.safe_load(path.read_text(encoding="utf-8"))):
        assert value is None or isinstance(value, (bool, int, float, str))
        assert not isinstance(value, str) or not set(value) & set("()[]{}= ")


MUJOCO = ("Reacher", "HalfCheetah", "Walker2d", "Hopper", "Swimmer")
# the tables of arXiv 2209.09174, appendix: actor's rule and rate, critic's rate, discount
TD3_TABLE = {
    "Reacher": ("adamw", 1e-4, 3e-4, 0.991),
    "HalfCheetah": ("adam", 5e-4, 4e-4, 0.992),
    "Walker2d": ("adam", 5e-4, 2e-4, 0.992),
    "Hopper": ("adamw", 1e-4, 3e-4, 0.991),
    "Swimmer": ("adam", 5e-4, 4e-4, 0.992),
}


@pytest.mark.parametrize("task", MUJOCO)
@pytest.mark.parametrize("version", ["v5", "v4"])
def test_settings_are_those_of_the_papers_tables(task: str, version: str) -> None:
    rule, actor_rate, critic_rate, gamma = TD3_TABLE[task]
    td3 = settings("td3", f"Sparse{task}-{version}")
    assert (td3["actor_kwargs"]["optimizer"], td3["actor_kwargs"]["learning_rate"]) == (rule, actor_rate)
    assert (td3["critic_kwargs"]["learning_rate"], td3["gamma"], td3["batch_size"]) == (critic_rate, gamma, 1024)
    assert (td3["target_policy_noise"], td3["policy_delay"], td3["noise_std"]) == (0.3, 5, 0.1)
    her = settings("her", f"Goal{task}-{version}")
    # the same rules and rates of the actor; the critic's are a tenth
    assert (her["actor_kwargs"]["optimizer"], her["actor_kwargs"]["learning_rate"]) == (rule, actor_rate)
    assert her["critic_kwargs"]["learning_rate"] == pytest.approx(critic_rate / 10)
    assert (her["gamma"], her["batch_size"], her["policy_kwargs"]["net_arch"]) == (0.98, 2048, [256, 256])
    logo = settings("logo", f"Sparse{task}-{version}")
    deltas = {"Reacher": 0.01, "HalfCheetah": 0.2, "Walker2d": 0.05, "Hopper": 0.01, "Swimmer": 0.2}
    assert (logo["guidance_delta"], logo["learning_rate"]) == (deltas[task], critic_rate)
    assert (logo["gamma"], logo["n_steps"], logo["guidance_iterations"]) == (0.991, 2048, 50)


def test_the_robosuite_settings_are_those_of_the_papers_table() -> None:
    lift, can = settings("ddpg", "SparseLift-v0"), settings("ddpg", "SparsePickPlaceCan-v0")
    for entry, expected in ((lift, (0.02, 0.05, 3e-4, 5e-4, 0.98)), (can, (0.05, 0.05, 3e-4, 3.5e-4, 0.989))):
        actor, critic = entry["actor_kwargs"], entry["critic_kwargs"]
        assert (actor["tau"], critic["tau"], actor["learning_rate"], critic["learning_rate"], entry["gamma"]) == expected
        assert entry["batch_size"] == 512
    assert lift["policy_kwargs"]["net_arch"] == {"pi": [512, 256], "qf": [512, 512]}
    assert can["policy_kwargs"]["net_arch"] == {"pi": [512, 256], "qf": [512, 256]}


@pytest.mark.parametrize("preset", ["td3", "her", "logo", "ddpg"])
def test_the_baselines_get_minus_one_for_a_miss_of_the_reacher(preset: str) -> None:
    prefix = "Goal" if preset == "her" else "Sparse"
    assert settings(preset, f"{prefix}Reacher-v5")["env_kwargs"] == {"miss_reward": -1.0}


def settings(preset: str, env_id: str) -> dict:
    from sb3_actpc.experiments.runs import load_preset

    register_envs()
    return load_preset(preset, env_id)
