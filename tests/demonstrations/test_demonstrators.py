"""Demonstrators are runs on the dense task; what is recorded of them is what was asked for."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_actpc.checkpoints import EXIT_STOPPED, TrainingStopped
from sb3_actpc.cli import demos
from sb3_actpc.demonstrations import Demonstrations, shipped_demonstrations
from sb3_actpc.envs import SPARSE_MUJOCO_IDS
from sb3_actpc.experiments import demonstrators
from sb3_actpc.experiments.demonstrators import (
    DEMONSTRATOR_ALGORITHMS,
    Demonstrator,
    demonstrator_run,
    record_demonstrators,
    reference_return,
    share_of,
    train_demonstrator,
    train_mixed,
)
from sb3_actpc.experiments.runs.presets import resolve
from sb3_actpc.experiments.runs.schema import Run

FEW: dict[str, dict[str, Any]] = {
    "ppo": {"n_steps": 64, "batch_size": 64, "n_epochs": 1},
    "trpo": {"n_steps": 64, "batch_size": 64, "n_critic_updates": 1},
    "sac": {"learning_starts": 50, "batch_size": 8},
    "td3": {"learning_starts": 50, "batch_size": 8},
}


def run_demos(*words: str) -> int:
    parser = argparse.ArgumentParser()
    demos.add_parser(parser.add_subparsers(dest="command", required=True))
    return demos.run(parser.parse_args(["demos", *words]))


def short_run(algo: str = "ppo", n_timesteps: int = 128, **options: Any) -> Run:
    return demonstrator_run(
        "SparseReacher-v5", algo, n_timesteps, settings=FEW[algo], eval_freq=64, progress=False, **{"seed": 1, **options}
    )


class Reaching:
    """Stands in for a trained agent: turns the Reacher's arm towards its target, and notes what it is asked for."""

    def __init__(self) -> None:
        self.deterministic: list[bool] = []

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, None]:
        self.deterministic.append(deterministic)
        cos, sin, _, velocity, offset = np.split(observation, [2, 4, 6, 8])
        first, elbow = np.arctan2(sin, cos)
        ends = np.array([[-0.1 * np.sin(first), 0.1 * np.cos(first)], [0.0, 0.0]])
        ends[1] = 0.11 * np.array([-np.sin(first + elbow), np.cos(first + elbow)])
        jacobian = np.stack([ends[0] + ends[1], ends[1]], axis=1)
        return np.clip(-20.0 * jacobian.T @ offset[:2] - 0.05 * velocity, -1.0, 1.0).astype(np.float32), None


@pytest.mark.parametrize("algo", sorted(DEMONSTRATOR_ALGORITHMS))
def test_every_task_is_learned_by_its_dense_base_task(algo: str) -> None:
    for env_id in SPARSE_MUJOCO_IDS:
        run = resolve(demonstrator_run(env_id, algo))
        assert run.env == env_id.removeprefix("Sparse") and run.policy == "MlpPolicy"
        assert (run.normalize is not None) is (algo in ("ppo", "trpo")), "the others are tuned without"
        assert run.demonstrations == "none"


def test_a_task_without_a_dense_reward_has_no_trained_demonstrator() -> None:
    with pytest.raises(ValueError, match="env_id='sb3_actpc:SparseLift-v0' has no dense reward to learn by"):
        demonstrator_run("sb3_actpc:SparseLift-v0")


@pytest.mark.parametrize("algo", sorted(DEMONSTRATOR_ALGORITHMS))
def test_the_agent_of_the_best_evaluation_demonstrates(algo: str, tmp_path: Path) -> None:
    said: list[str] = []
    trained = train_demonstrator(short_run(algo), tmp_path, said.append)
    rows = np.genfromtxt(tmp_path / "progress.csv", delimiter=",", names=True)
    assert rows["timesteps"][-1] >= 128
    best = rows[rows["dense_return"] == rows["dense_return"].max()][-1]
    assert (trained.mean_return, trained.n_steps) == (best["dense_return"], best["timesteps"])
    assert any("of the untrained agent" in line for line in said) is (trained.n_steps == 0)
    env = gym.make("Reacher-v5")
    observation, _ = env.reset(seed=0)
    action, _ = trained.policy.predict(observation, deterministic=True)
    assert env.action_space.contains(action)
    again = train_demonstrator(short_run(algo), tmp_path)
    np.testing.assert_array_equal(again.policy.predict(observation, deterministic=True)[0], action)
    assert len(np.genfromtxt(tmp_path / "progress.csv", delimiter=",", names=True)) == len(rows), "not trained again"
    env.close()


@pytest.mark.parametrize("is_finished", [True, False])
def test_a_folder_of_another_training_is_refused(is_finished: bool, tmp_path: Path) -> None:
    """The demonstrator there is better, or worse, than the one asked for; a longer training would be recorded as a shorter."""
    there = {"target_return": -1e9}
    assert train_demonstrator(short_run(**there), tmp_path).n_steps <= 64, "training stops at the target return"
    if not is_finished:
        (tmp_path / "result.json").unlink()
    for other, message in (
        ({**there, "seed": 2}, "holds another run"),
        ({"target_return": -1e8}, r"another run, with target_return=-1000000000.0 and not -100000000.0: .*--work-dir"),
        ({}, "another run, with target_return=-1000000000.0 and not None"),
        ({**there, "n_timesteps": 64}, "a training of 128 steps, not of 64: .*--work-dir, or say --steps 128"),
    ):
        with pytest.raises(ValueError, match=message):
            train_demonstrator(short_run(**other), tmp_path)


def test_a_mixed_set_is_by_a_demonstrator_and_itself_at_half_the_return(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, float | None] = {}

    def finish(run: Run, report: Any) -> dict[str, Any]:
        asked[run.folder.name] = run.target_return
        return {"kept_timesteps": 10, "dense_return": 3000.0 if run.target_return is None else run.target_return}

    monkeypatch.setattr(demonstrators, "finish_run", finish)
    monkeypatch.setattr(demonstrators, "load_run", lambda folder: (None, folder.name))
    both = train_mixed(demonstrator_run("SparseHopper-v5"), tmp_path / "hopper")
    assert asked == {"hopper": None, "hopper_earlier": 1500.0}
    assert [one.policy for one in both] == ["hopper", "hopper_earlier"]


def test_the_reference_is_what_the_packages_demonstrators_reach_and_a_share_of_it_is_never_better() -> None:
    assert [share_of(3000.0, 0.5), share_of(-4.0, 0.5), share_of(10.0, 1.0)] == [1500.0, -8.0, 10.0]
    shipped = Demonstrations.load(shipped_demonstrations("SparseHopper-v5")).dense_returns
    assert shipped is not None
    assert reference_return("SparseHopper-v5") == reference_return("GoalHopper-v4") == pytest.approx(shipped.mean())
    with pytest.raises(FileNotFoundError, match=r"no reference return of Pendulum-v1 .* give --target-return"):
        reference_return("Pendulum-v1")


@pytest.mark.parametrize("stochastic", [False, True])
def test_only_successful_episodes_are_kept_and_replay_in_the_sparse_task(stochastic: bool) -> None:
    policy = Reaching()
    reaching = Demonstrator(policy, 7, -3.0)
    shown = record_demonstrators([reaching], "SparseReacher-v5", 2, stochastic, seed=4, metadata={"note": "x"})
    assert set(policy.deterministic) == {not stochastic}
    assert shown.n_episodes == 2 and len(shown) == 100
    assert not shown.terminations.any(), "a time limit is not a termination"
    assert (shown.rewards[49::50] == 1.0).all(), "a Reacher's success is its last step"
    assert shown.metadata["note"] == "x" and shown.metadata["demonstrator_returns"] == [-3.0]
    assert shown.dense_rewards is not None
    env = gym.make("SparseReacher-v5")
    first = next(i for i in range(100) if np.allclose(env.reset(seed=4 + i)[0], shown.observations[0]))
    env.reset(seed=4 + first)
    for row in range(50):
        observation, reward, _, _, info = env.step(shown.actions[row])
        np.testing.assert_allclose(observation, shown.next_observations[row], atol=1e-5)
        assert reward == shown.rewards[row]
        assert info["dense_reward"] == pytest.approx(shown.dense_rewards[row], abs=1e-5)
    env.close()


class TestCommand:
    @pytest.mark.parametrize("env_id", ["sb3_actpc:SparseReacher-v5", "GoalReacher-v5"])
    def test_collect_writes_a_file_that_info_describes(
        self, env_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """What is recorded in the sparse task serves the goal task."""
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(demonstrators, "train_demonstrator", lambda *_: Demonstrator(Reaching(), 7, -3.0))
        assert run_demos("collect", "--env", env_id, "--episodes", "2", "--stochastic", "--steps", "1234567") == 0
        shown = Demonstrations.load("sparse_reacher.npz")
        command = (
            "sb3-actpc demos collect --env SparseReacher-v5 --algo ppo --steps 1234567 --stochastic --episodes 2 --seed 0"
        )
        assert shown.metadata["command"] == f"{command} --save-every 50000 --n-envs 1", "without the machine's paths"
        capsys.readouterr()
        assert run_demos("info", "sparse_reacher.npz") == 0
        printed = capsys.readouterr().out
        found = "env: SparseReacher-v5\nepisodes: 2\ntransitions: 100\nobservations: (10,), actions: (2,)\n"
        assert printed.startswith(f"{found}sparse return: mean {shown.episode_returns.mean():.1f}")
        assert command in printed

    @pytest.mark.parametrize(
        ("words", "target", "share", "is_said"),
        [
            ([], None, 0.4, True),
            ([], None, 0.6, False),
            (["--target-return", "5"], 5.0, 0.4, False),
            (["--quality", "0.5"], reference_return("SparseHopper-v5") / 2, 0.4, False),
        ],
    )
    def test_quality_is_a_target_return_and_others_are_compared_with_the_packages(
        self,
        words: list[str],
        target: float | None,
        share: float,
        is_said: bool,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        asked: list[Run] = []

        def train(run: Run, *_: Any) -> Demonstrator:
            asked.append(run)
            return Demonstrator(Reaching(), 7, -3.0)

        shown = Demonstrations.load(shipped_demonstrations("SparseHopper-v5"))
        poor = dataclasses.replace(shown, dense_rewards=share * shown.dense_rewards)  # type: ignore[operator]
        monkeypatch.setattr(demonstrators, "train_demonstrator", train)
        monkeypatch.setattr(demonstrators, "record_demonstrators", lambda *_, **options: poor)
        run_demos("collect", "--env", "SparseHopper-v5", "--algo", "trpo", "--output", str(tmp_path / "x.npz"), *words)
        assert [(run.target_return, run.algo, run.env) for run in asked] == [(target, "trpo", "Hopper-v5")]
        text = f"mean dense return {poor.dense_returns.mean():.1f} is far below {shown.dense_returns.mean():.1f}"
        printed = capsys.readouterr().out
        assert (text in printed) == ("--steps" in printed) == is_said

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["--algo", "dqn"], "algo='dqn' is not one of ppo, sac, td3, trpo"),
            (["--algo", "td3", "--stochastic"], "the policy of td3 has nothing to sample"),
            (["--quality", "0.5", "--target-return", "3"], "both say when to stop"),
            (["--quality", "1.5"], "quality=1.5 must be above 0 and at most 1"),
            (["--proficiency", "0.5"], "are for scripted demonstrators"),
            (["--env", "SparseLift-v0", "--quality", "0.5"], "are for trained demonstrators: give --proficiency"),
            (["--env", "SparseLift-v0", "--mixed", "--proficiency", "0.5"], "give one of the two"),
            (["--env", "CartPole-v1"], "CartPole-v1: demonstrations need a Box action space, found Discrete"),
        ],
    )
    def test_options_that_do_not_go_together_are_named(self, words: list[str], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            run_demos("collect", "--env", "SparseHopper-v5", *words)

    def test_a_training_that_is_stopped_says_how_to_go_on(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        def stop(*_: Any) -> None:
            raise TrainingStopped("SIGTERM", 500, "somewhere")

        monkeypatch.setattr(demonstrators, "train_demonstrator", stop)
        assert run_demos("collect", "--env", "SparseHopper-v5") == EXIT_STOPPED
        assert "SIGTERM at step 500, saved in somewhere; the same command goes on with it" in capsys.readouterr().err

    def test_an_unknown_task_and_files_that_cannot_be_used_are_named(self, tmp_path: Path) -> None:
        with pytest.raises(IsADirectoryError, match=r"is a folder: give the file in it, such as .*demos\.npz"):
            run_demos("collect", "--env", "SparseHopper-v5", "--output", str(tmp_path))
        with pytest.raises(SystemExit):
            run_demos("collect", "--env", "SparseHopper-v5", "--episodes", "0")
        with pytest.raises(gym.error.Error, match="SparseAnt"):
            run_demos("collect", "--env", "SparseAnt-v5")
        with pytest.raises(FileNotFoundError, match=r"no demonstration file .*absent\.npz: make one"):
            run_demos("info", str(tmp_path / "absent.npz"))
