"""Every entry of every settings file builds its agent on its environment, and the agent trains."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
import yaml

from sb3_actpc import ActPC
from sb3_actpc.envs import ROBOSUITE_IDS, sparse_env_id
from sb3_actpc.experiments.runs import ALGORITHMS, Run, load_preset, resolve
from sb3_actpc.experiments.runs.environments import make_train_env, register_tasks
from sb3_actpc.experiments.runs.run import build_model
from sb3_actpc.utils.preset_files import HYPERPARAMS_FOLDERS
from sb3_actpc.utils.settings import constructor_settings
from tests.recordings import record_file

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date.*", "ignore:.*infinity.*", "ignore:.*mini-batch size.*")
FOLDER = next(folder for folder in HYPERPARAMS_FOLDERS if folder.is_dir())
# settings of a preset that is no algorithm's
ALGO_OF = {
    "actpc_paper": "actpc",
    "actpc_faithful": "actpc",
    "ppo_demonstrator": "ppo",
    "rlpd_published": "rlpd",
    "td3_demonstrator": "td3",
}
N_EPISODES = 26  # of 12 steps: the paper's preset asks for 300 transitions
DEFAULT_ENV = {"her": "GoalHopper-v5", **dict.fromkeys(("ppo", "sac", "trpo"), "Hopper-v5")}
# what would take long, and nothing else
OFF_POLICY = {"learning_starts": 0, "buffer_size": 1000, "batch_size": 8}
FEWER: dict[str, dict[str, Any]] = {
    "actpc": {**OFF_POLICY, "signal_kwargs.prior_updates": 2},
    "her": {**OFF_POLICY, "demonstration_fraction": 1.0},
    "bc": {"batch_size": 8},
    "bcq": {"batch_size": 8},
    "cql": {"batch_size": 8},
    "bc_rnn": {"batch_size": 8},
    **dict.fromkeys(("sac", "td3"), OFF_POLICY),
    "ddpg": OFF_POLICY,
    "rlpd": OFF_POLICY,
    "ibrl": {**OFF_POLICY, "bc_steps": 20},
    "logo": {"n_steps": 16, "batch_size": 8, "n_critic_updates": 1},
    "ppo": {"n_steps": 16, "batch_size": 8, "n_epochs": 1},
    "trpo": {"n_steps": 16, "batch_size": 8, "n_critic_updates": 1},
}


def entries() -> list[tuple[str, str]]:
    """(preset, key) of every entry."""
    return [
        (path.stem, key) for path in sorted(FOLDER.glob("*.yml")) for key in yaml.safe_load(path.read_text(encoding="utf-8"))
    ]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the demonstrations of each task are, recorded once."""
    return tmp_path_factory.mktemp("recordings")


@pytest.mark.parametrize(("preset", "key"), entries())
def test_every_entry_builds_its_agent_which_trains(preset: str, key: str, recordings: Path) -> None:
    algo = ALGO_OF.get(preset, preset)
    if algo in ("bcq", "cql"):
        pytest.importorskip("d3rlpy", reason="d3rlpy is an extra")
    if algo == "rlpd":
        pytest.importorskip("sbx", reason="sbx is an extra")
    env_id = DEFAULT_ENV.get(algo, "SparseHopper-v5") if key == "default" else key
    register_tasks(env_id)
    if env_id not in gym.registry:
        pytest.skip(f"{env_id} is not registered")
    if env_id in ROBOSUITE_IDS:
        pytest.importorskip("robosuite", reason="robosuite is an extra")
    sparse = sparse_env_id(env_id)
    demonstrations = str(record_file(recordings, sparse, N_EPISODES)) if sparse.startswith("Sparse") else "none"
    n_steps = 16 if algo in ("logo", "ppo", "trpo") else 3
    settings = dict(FEWER[algo])
    if algo in ("her", "actpc") and demonstrations == "none":  # nothing to learn from but an episode of its own
        settings["learning_starts"], n_steps = 50, 52
    run = resolve(Run(env=env_id, algo=algo, preset=preset, demonstrations=demonstrations, settings=settings))
    env = make_train_env(env_id, run.env_kwargs, run.n_envs, 0, run.normalize)
    try:
        model = build_model(run, env)
        before = [parameter.clone() for parameter in model.policy.parameters()]
        model.learn(n_steps)
        assert model._n_updates > 0
        if algo in ("bcq", "cql"):  # their networks are no part of the policy
            return
        after = list(model.policy.parameters())
        assert all(bool(th.isfinite(parameter).all()) for parameter in after)
        assert not all(th.equal(*pair) for pair in zip(before, after, strict=True))
    finally:
        env.close()


def test_the_settings_of_a_task_are_the_constructors_defaults(recordings: Path) -> None:
    """All of them, the policy's too: who writes three lines of Python gets the agent of the command."""
    env_id = "SparseHopper-v5"
    demonstrations = record_file(recordings, env_id)
    run = resolve(Run(env=env_id, demonstrations=str(demonstrations)))
    by_command = build_model(run, make_train_env(env_id, run.env_kwargs, run.n_envs, run.seed, run.normalize))
    by_hand = ActPC("MlpPolicy", env_id, demonstrations=demonstrations, seed=run.seed)
    one, other = constructor_settings(by_command), constructor_settings(by_hand)
    assert len(one["keywords"]) > 25 and "demonstrations" in one["keywords"]
    assert one == other
    assert set(load_preset("actpc", env_id)) <= {"n_timesteps", "policy"}


def test_every_algorithm_has_settings_with_a_default() -> None:
    found = entries()
    assert {(algo, "default") for algo in ALGORITHMS} <= set(found)
