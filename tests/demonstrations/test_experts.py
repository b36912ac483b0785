"""Experts go on from their checkpoints, and only their successes become demonstrations."""

import argparse
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_actpc.cli import demos
from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.experts import (
    EXPERT_ALGORITHMS,
    Expert,
    ExpertTraining,
    collect_demonstrations,
    default_expert_steps,
    expert_hyperparams,
    load_expert,
    train_expert,
)
from sb3_actpc.envs import SPARSE_MUJOCO_IDS, dense_env_id

REACHER = ExpertTraining("SparseReacher-v5", "ppo", seed=1, n_envs=2)


def run_demos(*words: str) -> int:
    parser = argparse.ArgumentParser()
    demos.add_parser(parser.add_subparsers(dest="command", required=True))
    return demos.run(parser.parse_args(["demos", *words]))


class ReachingModel:
    """Stands in for a trained agent: a controller that turns the Reacher's arm towards its target."""

    def predict(self, observation: np.ndarray, deterministic: bool = True) -> tuple[np.ndarray, None]:
        cos, sin, _, velocity, offset = np.split(observation, [2, 4, 6, 8])
        first, elbow = np.arctan2(sin, cos)
        ends = np.array([[-0.1 * np.sin(first), 0.1 * np.cos(first)], [0.0, 0.0]])
        ends[1] = 0.11 * np.array([-np.sin(first + elbow), np.cos(first + elbow)])
        jacobian = np.stack([ends[0] + ends[1], ends[1]], axis=1)
        return np.clip(-20.0 * jacobian.T @ offset[:2] - 0.05 * velocity, -1.0, 1.0).astype(np.float32), None


@pytest.fixture
def reaching_expert() -> Expert:
    return Expert(ReachingModel(), None, 0, 0.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("algorithm", sorted(EXPERT_ALGORITHMS))
def test_every_task_has_settings_its_algorithm_accepts(algorithm: str, tmp_path: Path) -> None:
    for env_id in SPARSE_MUJOCO_IDS:
        assert expert_hyperparams(algorithm, dense_env_id(env_id))["policy"] == "MlpPolicy"
    expert = train_expert(ExpertTraining("SparseHopper-v5", algorithm), 8, tmp_path)
    assert isinstance(expert.model, EXPERT_ALGORITHMS[algorithm])
    assert (expert.normalization is not None) is (algorithm == "ppo")


def test_the_default_training_is_2000_full_episodes() -> None:
    assert default_expert_steps("SparseHalfCheetah-v5") == 2_000_000
    assert default_expert_steps("SparseReacher-v4") == 100_000


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_a_stopped_training_goes_on_from_its_newest_checkpoint(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = ExpertTraining("SparseReacher-v5", algorithm)
    lines: list[str] = []
    train_expert(training, 512, tmp_path, save_every=256, report=lines.append)
    trained: list[int] = []
    algorithm_class = EXPERT_ALGORITHMS[algorithm]
    learn = algorithm_class.learn

    def spy(self: BaseAlgorithm, total_timesteps: int, **kwargs: object) -> BaseAlgorithm:
        trained.append(total_timesteps)
        assert self.num_timesteps == 512
        if algorithm == "sac":
            assert self.replay_buffer.size() == 512, "its experience comes back too"
        return learn(self, total_timesteps, **kwargs)

    monkeypatch.setattr(algorithm_class, "learn", spy)
    train_expert(training, 1024, tmp_path, save_every=256, report=lines.append)
    assert trained == [512]
    assert "going on from" in " ".join(lines)
    train_expert(training, 1024, tmp_path)
    assert trained == [512], "a finished training is not trained again"


def test_a_half_written_checkpoint_is_not_used(tmp_path: Path) -> None:
    train_expert(REACHER, 512, tmp_path)
    (whole,) = tmp_path.iterdir()
    shutil.copytree(whole, tmp_path / "step_000009999.tmp")
    (tmp_path / "step_000009999.tmp" / "state.json").unlink()
    assert load_expert(REACHER, tmp_path).n_steps == 512


def test_training_stops_at_the_target_return(tmp_path: Path) -> None:
    expert = train_expert(REACHER, 100_000, tmp_path, save_every=512, target_return=-1e9)
    assert expert.n_steps <= 1024
    assert train_expert(REACHER, 100_000, tmp_path, target_return=-1e9).n_steps == expert.n_steps


def test_a_loaded_expert_acts_as_the_one_that_was_saved(tmp_path: Path) -> None:
    expert = train_expert(REACHER, 512, tmp_path)
    loaded = load_expert(REACHER, tmp_path)
    env = gym.make("Reacher-v5")
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(expert.predict(observation), loaded.predict(observation))
        assert env.action_space.contains(loaded.predict(observation))


def test_a_work_directory_of_another_expert_is_refused(tmp_path: Path) -> None:
    train_expert(REACHER, 512, tmp_path)
    with pytest.raises(ValueError, match=r"holds the expert .*'seed': 1.* not .*'seed': 2.*another work directory"):
        train_expert(ExpertTraining("SparseReacher-v5", "ppo", seed=2, n_envs=2), 512, tmp_path)


def test_bad_expert_settings_name_the_value_and_the_fix(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"algorithm='dqn' is not one of \['ppo', 'sac', 'td3'\]"):
        ExpertTraining("SparseReacher-v5", "dqn")
    with pytest.raises(ValueError, match=r"n_envs=0 must be at least 1"):
        ExpertTraining("SparseReacher-v5", n_envs=0)
    with pytest.raises(ValueError, match=r"env_id='Reacher-v5' is not a sparse MuJoCo task: choose one of"):
        ExpertTraining("Reacher-v5")
    with pytest.raises(ValueError, match=r"n_steps=0 must be at least 1"):
        train_expert(REACHER, 0, tmp_path)
    with pytest.raises(FileNotFoundError, match="no expert checkpoint in"):
        load_expert(REACHER, tmp_path)


def test_only_successful_episodes_are_kept_and_replay_in_the_sparse_task(reaching_expert: Expert) -> None:
    demonstrations = collect_demonstrations(reaching_expert, "SparseReacher-v5", n_episodes=3, seed=4, metadata={"note": "x"})
    assert demonstrations.n_episodes == 3
    assert demonstrations.observations.shape == (150, 10)
    assert demonstrations.observations.dtype == demonstrations.actions.dtype == np.float32
    assert not demonstrations.terminations.any(), "a time limit is not a termination"
    assert (demonstrations.rewards[49::50] == 1.0).all(), "a Reacher's success is its last step"
    assert demonstrations.metadata["note"] == "x"

    env = gym.make("SparseReacher-v5")
    first = next(i for i in range(100) if np.allclose(env.reset(seed=4 + i)[0], demonstrations.observations[0]))
    env.reset(seed=4 + first)
    for row in range(50):
        observation, reward, _, _, info = env.step(demonstrations.actions[row])
        np.testing.assert_allclose(observation, demonstrations.next_observations[row], atol=1e-5)
        assert reward == demonstrations.rewards[row]
        assert info["dense_reward"] == pytest.approx(demonstrations.dense_rewards[row], abs=1e-5)


def test_an_expert_that_does_not_succeed_is_refused(tmp_path: Path) -> None:
    expert = train_expert(ExpertTraining("SparseHalfCheetah-v5"), 8, tmp_path)
    with pytest.raises(ValueError, match=r"only 0 of 2 episodes succeeded in SparseHalfCheetah-v5, 1 are needed"):
        collect_demonstrations(expert, "SparseHalfCheetah-v5", n_episodes=1, max_tries=2)


def test_collect_writes_a_file_that_info_describes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], reaching_expert: Expert
) -> None:
    monkeypatch.setattr("sb3_actpc.demonstrations.experts.train_expert", lambda *_: reaching_expert)
    output = tmp_path / "reacher.npz"
    assert run_demos("collect", "--env", "SparseReacher-v5", "--episodes", "2", "--output", str(output)) == 0
    demonstrations = Demonstrations.load(output)
    assert demonstrations.env_id == "SparseReacher-v5"
    command = demonstrations.metadata["command"]
    assert command.startswith("sb3-actpc demos collect --env SparseReacher-v5 --algo ppo --episodes 2")
    assert str(tmp_path) not in command
    capsys.readouterr()
    assert run_demos("info", str(output)) == 0
    printed = capsys.readouterr().out
    for line in ("env: SparseReacher-v5", "episodes: 2", "transitions: 100", "observations: (10,), actions: (2,)", command):
        assert line in printed
    assert f"sparse return: mean {demonstrations.episode_returns.mean():.1f}" in printed
    assert f"dense return: mean {demonstrations.dense_returns.mean():.1f}" in printed


def test_an_unknown_task_and_a_missing_file_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"env_id='SparseAnt-v5' is not a sparse MuJoCo task"):
        run_demos("collect", "--env", "SparseAnt-v5")
    with pytest.raises(FileNotFoundError, match=r"no demonstration file .*absent\.npz: make one"):
        run_demos("info", str(tmp_path / "absent.npz"))
