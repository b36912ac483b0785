"""Behaviour cloning: least squares without hidden layers, a state that is the unrolled sequence's, the same after loading."""

import csv
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_actpc.baselines import BC, BCRNN
from sb3_actpc.baselines.bc_policies import BCRNNPolicy
from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.experiments.runs import Run, train_run
from sb3_actpc.experiments.runs.evaluation import play_episodes
from tests.recordings import record

ENV = "Pendulum-v1"
SMALL = {"net_arch": [8]}
SMALL_RNN = {"hidden_size": 6}


def make(kind: type[BC] = BC, **options: object) -> BC:
    options = {"policy_kwargs": SMALL_RNN if kind is BCRNN else SMALL, "batch_size": 8, "seed": 0, **options}
    return kind("MlpPolicy", ENV, demonstrations=record(ENV), device="cpu", **options)


def demonstrated(actions: np.ndarray, observations: np.ndarray, starts: list[int]) -> Demonstrations:
    """Pendulum's, with any observations and actions, in [-2, 2]."""
    n = len(actions)
    return Demonstrations(
        observations, actions, observations, np.zeros(n), np.zeros(n, dtype=bool), np.array(starts), env_id=ENV
    )


def test_without_hidden_layers_it_finds_the_least_squares_solution() -> None:
    rng = np.random.default_rng(0)
    observations = rng.normal([1.0, -2.0, 0.5], [0.5, 2.0, 1.0], (200, 3)).astype(np.float32)
    actions = observations @ [[0.2], [-0.1], [0.15]] + 0.1 + rng.normal(0, 0.1, (200, 1))  # noisy: there is a residual
    actions = np.clip(actions, -2, 2).astype(np.float32)
    shown = demonstrated(actions, observations, [0])
    model = BC(
        "MlpPolicy",
        ENV,
        demonstrations=shown,
        policy_kwargs={"net_arch": []},
        learning_rate=LinearSchedule(0.03, 0.0, 1.0),
        batch_size=200,
        seed=0,
        device="cpu",
    ).learn(1500)
    design = np.column_stack([observations, np.ones(200)]).astype(np.float64)
    solution = np.linalg.lstsq(design, actions.astype(np.float64), rcond=None)[0]
    found, _ = model.predict(observations, deterministic=True)
    # batches are drawn with replacement: the last steps' noise is what is left
    assert np.abs(found - design @ solution).max() < 0.02
    assert np.abs(design @ solution - actions).max() > 0.15  # far below what the solution itself leaves


def test_a_step_is_a_gradient_step_and_the_environment_stands_still() -> None:
    class Count(BaseCallback):
        steps: tuple[int, ...] = ()

        def _on_step(self) -> bool:
            self.steps = *self.steps, self.num_timesteps
            return True

    model, count = make(), Count()
    vec_env = model.env
    assert vec_env is not None
    model.learn(7, callback=count)
    assert count.steps == (1, 2, 3, 4, 5, 6, 7) and model._n_updates == model.num_timesteps == 7
    assert vec_env.get_attr("_elapsed_steps") == [0]
    model.learn(3, reset_num_timesteps=False)
    assert model.num_timesteps == 10


def test_no_log_interval_is_no_log(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make()
    dumped: list[int] = []
    monkeypatch.setattr(Logger, "dump", lambda _, step=0: dumped.append(step))
    assert model.learn(4, log_interval=None).num_timesteps == 4
    assert not dumped
    model.learn(4, log_interval=2)
    assert dumped == [2, 4]


def test_demonstrated_observations_have_mean_zero_and_standard_deviation_one() -> None:
    shown = record(ENV)
    model = make()
    inputs = model.policy.normalized(th.as_tensor(shown.observations))
    th.testing.assert_close(inputs.mean(dim=0), th.zeros(3), atol=1e-4, rtol=0)
    th.testing.assert_close(inputs.std(dim=0, correction=0), th.ones(3), atol=1e-4, rtol=0)


@pytest.mark.parametrize("cell", ["gru", "lstm"])
def test_a_carried_state_acts_as_the_whole_sequence_unrolled(cell: str) -> None:
    model = make(BCRNN, carry_state=True, policy_kwargs={**SMALL_RNN, "cell": cell, "n_layers": 2}).learn(20)
    policy = model.policy
    observations = record(ENV, n_episodes=2, n_steps=12).observations.reshape(2, 12, 3)
    with th.no_grad():
        whole = policy(policy.normalized(th.as_tensor(observations)))[0].clamp(-1, 1)
    state, actions = None, []
    for step in range(12):
        action, state = model.predict(observations[:, step], state, np.full(2, step == 0), deterministic=True)
        actions.append(action)
    np.testing.assert_allclose(np.stack(actions, axis=1), 2.0 * whole.numpy(), atol=1e-5)


def test_the_state_begins_anew_after_as_many_steps_as_a_sequence_has() -> None:
    model = make(BCRNN, sequence_length=4).learn(20)
    observations = record(ENV, n_episodes=1, n_steps=8).observations
    with th.no_grad():
        halves = model.policy(model.policy.normalized(th.as_tensor(observations)).reshape(2, 4, 3))[0].clamp(-1, 1)
    state, actions = None, []
    for row in observations:
        action, state = model.predict(row, state)
        actions.append(action)
    np.testing.assert_allclose(np.stack(actions), 2.0 * halves.reshape(8, 1).numpy(), atol=1e-5)


def test_an_episodes_start_empties_its_own_state_only() -> None:
    model = make(BCRNN, carry_state=True).learn(20)
    rows = record(ENV).observations[:2]
    _, state = model.predict(rows)
    fresh, _ = model.predict(rows)
    carried, _ = model.predict(rows, state)
    mixed, _ = model.predict(rows, state, np.array([True, False]))
    assert not np.allclose(fresh, carried)
    np.testing.assert_array_equal(mixed[0], fresh[0])
    np.testing.assert_array_equal(mixed[1], carried[1])


def test_what_lies_behind_an_episodes_end_is_not_learned_from() -> None:
    """With all episodes one step long, sequences are one step long: the same error whatever the next episode holds."""
    observations = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    actions = np.linspace(-2, 2, 20, dtype=np.float32)[:, None]
    shown = demonstrated(actions, observations, list(range(20)))
    model = BCRNN("MlpPolicy", ENV, demonstrations=shown, policy_kwargs=SMALL_RNN, seed=0, device="cpu")
    outputs, _ = model.policy(model._inputs(th.arange(20), 0.0)[:, None])
    expected = (outputs[:, 0] - th.as_tensor(actions) / 2).square().mean()
    th.testing.assert_close(model._loss(model.policy, th.arange(20)), expected)


@pytest.mark.parametrize("kind", [BC, BCRNN])
def test_it_plays_the_same_after_loading_and_goes_on_learning(kind: type[BC], tmp_path: Path) -> None:
    shown = tmp_path / "shown.npz"
    record(ENV).save(shown)
    kwargs = SMALL_RNN if kind is BCRNN else SMALL
    model = kind("MlpPolicy", ENV, demonstrations=shown, policy_kwargs=kwargs, seed=0, device="cpu").learn(20)
    model.save(tmp_path / "model.zip")
    model.policy.save(tmp_path / "policy.zip")
    loaded = kind.load(tmp_path / "model.zip", device="cpu")
    policy = type(model.policy).load(tmp_path / "policy.zip", device="cpu")
    rows = record(ENV).observations[:3]
    for other in (loaded, policy):
        np.testing.assert_array_equal(model.predict(rows)[0], other.predict(rows)[0])
    with pytest.raises(ValueError, match="set_env"):
        loaded.learn(1)
    loaded.set_env(make_vec_env(ENV))
    loaded.learn(1)
    assert not np.array_equal(model.predict(rows)[0], loaded.predict(rows)[0])


def test_a_saved_agent_names_its_demonstrations_as_they_were_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    record(ENV).save("mine.npz")
    BC("MlpPolicy", ENV, demonstrations=Path("mine.npz"), policy_kwargs=SMALL, device="cpu").save("cloned")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    assert BC.load("../cloned", device="cpu").demonstrations == "mine.npz"  # to be played it needs none
    with pytest.raises(FileNotFoundError, match=r"at mine.npz; or pass demonstrations=, which load\(path, env=env"):
        BC.load("../cloned", env=gym.make(ENV), device="cpu")
    assert BC.load("../cloned", env=gym.make(ENV), demonstrations="../mine.npz", device="cpu").learn(1).num_timesteps == 1


def test_two_runs_with_one_seed_are_equal() -> None:
    first, second = (make(BCRNN, input_noise=0.1).learn(10).policy.state_dict() for _ in range(2))
    assert all(th.equal(first[name], second[name]) for name in first)


def test_the_shared_evaluation_carries_the_state() -> None:
    seen = []

    class Watched(BCRNNPolicy):
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            seen.append(None if state is None else state[-1].tolist())
            return super().predict(observation, state, episode_start, deterministic)

    model = BCRNN(Watched, ENV, demonstrations=record(ENV), policy_kwargs=SMALL_RNN, carry_state=True, device="cpu")
    envs = [gym.make(ENV, max_episode_steps=3) for _ in range(2)]
    play_episodes(model, envs, 2, 0)
    assert seen == [None, [1, 1], [2, 2]]


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (BC, {"demonstrations": None}, "demonstrations=None: BC learns from nothing else"),
        (BC, {"batch_size": 0}, "batch_size=0 must be at least 1"),
        (BC, {"batch_size": 2.5}, "batch_size=2.5 must be a whole number"),
        (BC, {"input_noise": -1.0}, "input_noise=-1.0 must be at least 0"),
        (BC, {"weight_decay": float("nan")}, "weight_decay=nan must be a finite number"),
        (BC, {"n_demonstrations": 99}, "n_demonstrations=99.*: n_episodes must be"),
        (BCRNN, {"sequence_length": 0}, "sequence_length=0 must be at least 1"),
        (BCRNN, {"carry_state": 1}, "carry_state=1 must be True or False"),
        (BCRNN, {"policy_kwargs": {"cell": "elman"}}, "cell='elman' is unknown; choose one of"),
        (BCRNN, {"policy_kwargs": {"hidden_size": 0}}, "hidden_size=0 must be at least 1"),
    ],
)
def test_wrong_settings_are_named(kind: type[BC], options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kind("MlpPolicy", ENV, **{"demonstrations": record(ENV), "device": "cpu", **options})


def test_what_it_cannot_act_on_is_refused() -> None:
    model = make(BCRNN)
    rows = record(ENV).observations[:3]
    _, state = model.predict(rows)
    with pytest.raises(ValueError, match="state has arrays of shapes"):
        model.predict(rows[:2], state)
    with pytest.raises(ValueError, match="episode_start has 1 entries for 3 observations"):
        model.predict(rows, state, np.array([True]))
    with pytest.raises(ValueError, match="needs Box observations"):
        BCRNNPolicy(spaces.Dict({"a": spaces.Box(0, 1)}), spaces.Box(-1, 1), lambda _: 1e-3)
    with pytest.raises(ValueError, match="leave VecNormalize out"):
        BC("MlpPolicy", VecNormalize(make_vec_env(ENV)), demonstrations=record(ENV), device="cpu")


def test_an_offline_method_is_evaluated_at_every_interval_and_others_before_their_first_step(tmp_path: Path) -> None:
    """Steps 10, 20 and 30 of BC; ActPC also at 0, after BC, or in five episodes at most where it has none.
    Where a gate deploys a policy, the actor plays as many."""
    steps, episodes, imitated = {}, {}, {}
    played: list[tuple[int, bool]] = []

    def counted(model: Any, envs: Any, n_episodes: int, seed: int) -> Any:
        played.append((n_episodes, getattr(model, "is_pretrained", False)))
        return play_episodes(model, envs, n_episodes, seed)

    short = {"bc_updates": 2}
    kinds = {"bc": ("bc", {}), "untrained": ("actpc", {"guidance": "none"}), "cloned": ("actpc", {"guidance_kwargs": short})}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sb3_actpc.experiments.runs.evaluation.play_episodes", counted)
        for name, (algo, settings) in kinds.items():
            played.clear()
            folder = tmp_path / name
            train_run(
                Run(
                    env="SparseReacher-v5", algo=algo, n_timesteps=30, eval_freq=10, eval_episodes=6, checkpoint_freq=0,
                    progress=False, output=str(folder), settings={"batch_size": 4} | settings,
                )
            )  # fmt: skip
            with open(folder / "progress.csv", encoding="utf-8") as file:
                steps[name] = [int(row["timesteps"]) for row in csv.DictReader(file)]
            episodes[name], imitated[name] = [n for n, _ in played], played[0][1]
    assert steps == {"bc": [10, 20, 30], "untrained": [0, 10, 20, 30], "cloned": [0, 10, 20, 30]}
    assert episodes == {"bc": [6, 6, 6], "untrained": [5, 6, 6, 6], "cloned": [6] * 8}  # deployed policy, then actor
    assert imitated["cloned"]
    assert not imitated["untrained"]
