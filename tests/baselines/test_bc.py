"""Behavior cloning: least squares without hidden layers, a state that is the unrolled sequence's, the same after loading."""

import csv
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_actpc.baselines import BC, BCRNN
from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.experiments.runs import Run, train_run
from sb3_actpc.experiments.runs.evaluation import play_episodes
from tests.recordings import record

ENV = "Pendulum-v1"
SMALL = {"net_arch": [8]}
SMALL_RNN = {"hidden_size": 6}


def make(kind: type[BC] = BC, **options: Any) -> BC:
    small = {"policy_kwargs": SMALL_RNN if kind is BCRNN else SMALL, "batch_size": 8, "seed": 0}
    env = options.pop("env", ENV)
    policy = "MlpPolicy" if env is ENV else "MultiInputPolicy"
    return kind(policy, env, device="cpu", **{"demonstrations": record(ENV), **small, **options})


def demonstrated(actions: np.ndarray, observations: np.ndarray, starts: list[int]) -> Demonstrations:
    """Pendulum's, with any observations and actions, in [-2, 2]."""
    n = len(actions)
    rewards, ends = np.zeros(n), np.zeros(n, dtype=bool)
    return Demonstrations(observations, actions, observations, rewards, ends, np.array(starts), env_id=ENV)


def test_without_hidden_layers_it_finds_the_least_squares_solution() -> None:
    rng = np.random.default_rng(0)
    observations = rng.normal([1.0, -2.0, 0.5], [0.5, 2.0, 1.0], (200, 3)).astype(np.float32)
    actions = observations @ [[0.2], [-0.1], [0.15]] + 0.1 + rng.normal(0, 0.1, (200, 1))  # noisy: there is a residual
    actions = np.clip(actions, -2, 2).astype(np.float32)
    options = {"policy_kwargs": {"net_arch": []}, "learning_rate": LinearSchedule(0.03, 0.0, 1.0), "batch_size": 200}
    model = make(demonstrations=demonstrated(actions, observations, [0]), **options).learn(1500)
    design = np.column_stack([observations, np.ones(200)]).astype(np.float64)
    solution = np.linalg.lstsq(design, actions.astype(np.float64), rcond=None)[0]
    found, _ = model.predict(observations, deterministic=True)
    # batches are drawn with replacement: the last steps' noise is what is left
    assert np.abs(found - design @ solution).max() < 0.02
    assert np.abs(design @ solution - actions).max() > 0.15  # far below what the solution itself leaves


def test_a_step_is_a_gradient_step_the_environment_stands_still_and_the_log_has_its_interval(tmp_path: Path) -> None:
    class Count(BaseCallback):
        steps: tuple[int, ...] = ()

        def _on_step(self) -> bool:
            self.steps = *self.steps, self.num_timesteps
            return True

    class Refuses(gym.Wrapper):
        def step(self, action: np.ndarray) -> Any:
            raise AssertionError("it must not be stepped")

    model, count = make(), Count()
    model.set_env(Refuses(gym.make(ENV)))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(7, callback=count, log_interval=None)
    assert count.steps == (1, 2, 3, 4, 5, 6, 7)
    assert not (tmp_path / "progress.csv").read_text()
    model.learn(300, reset_num_timesteps=False, log_interval=100)
    assert model.num_timesteps == 307
    with open(tmp_path / "progress.csv", encoding="utf-8") as file:
        assert [row["train/n_updates"] for row in csv.DictReader(file)] == ["100", "200", "300"]


def test_demonstrated_observations_have_mean_zero_and_standard_deviation_one() -> None:
    inputs = make().policy.normalized(th.as_tensor(record(ENV).observations))
    th.testing.assert_close(inputs.mean(dim=0), th.zeros(3), atol=1e-4, rtol=0)
    th.testing.assert_close(inputs.std(dim=0, correction=0), th.ones(3), atol=1e-4, rtol=0)


def test_the_state_begins_anew_after_as_many_steps_as_a_sequence_has() -> None:
    model = make(BCRNN, sequence_length=4).learn(20)
    observations = record(ENV, n_episodes=1, n_steps=8).observations
    with th.no_grad():
        halves = model.policy(model.policy.normalized(th.as_tensor(observations)).reshape(2, 4, 3)).clamp(-1, 1)
    state, actions = None, []
    for row in observations:
        action, state = model.predict(row, state)
        actions.append(action)
    np.testing.assert_allclose(np.stack(actions), 2.0 * halves.reshape(8, 1).numpy(), atol=1e-5)


def test_an_episodes_start_empties_its_own_state_only() -> None:
    model = make(BCRNN).learn(20)
    rows = record(ENV).observations[:2]
    fresh, state = model.predict(rows)
    carried, _ = model.predict(rows, state)
    mixed, _ = model.predict(rows, state, np.array([True, False]))
    assert not np.allclose(fresh, carried)
    np.testing.assert_array_equal(mixed, np.stack([fresh[0], carried[1]]))


def test_what_lies_behind_an_episodes_end_is_not_learned_from() -> None:
    """Where all episodes have one step, a sequence has one step, however long it may be."""
    observations = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    shown = demonstrated(np.linspace(-2, 2, 20, dtype=np.float32)[:, None], observations, list(range(20)))
    short, long = (make(BCRNN, demonstrations=shown, sequence_length=length).learn(30) for length in (1, 5))
    np.testing.assert_allclose(short.predict(observations)[0], long.predict(observations)[0], atol=1e-5)


@pytest.mark.parametrize("kind", [BC, BCRNN])
def test_it_plays_the_same_after_loading_and_goes_on_learning(kind: type[BC], tmp_path: Path) -> None:
    shown = tmp_path / "shown.npz"
    record(ENV).save(shown)
    model = make(kind, demonstrations=shown, held_out_fraction=0.0).learn(20)
    model.save(tmp_path / "model.zip")
    loaded = kind.load(tmp_path / "model.zip", device="cpu")
    rows = record(ENV).observations[:3]
    np.testing.assert_array_equal(model.predict(rows)[0], loaded.predict(rows)[0])
    loaded.set_env(make_vec_env(ENV))
    loaded.learn(1)
    assert not np.array_equal(model.predict(rows)[0], loaded.predict(rows)[0])
    with pytest.raises(ValueError, match="cannot be saved without its agent"):
        model.policy.save(str(tmp_path / "policy.pth"))


@pytest.mark.parametrize("kind", [BC, BCRNN])
def test_a_loaded_agent_goes_on_from_its_policy(kind: type[BC], tmp_path: Path) -> None:
    shown = demonstrated(np.tile([[-1.0], [1.0]], (30, 1)), np.tile([[-1.0] * 3, [1.0] * 3], (30, 1)), list(range(0, 60, 6)))

    def error(model: BC) -> float:
        return float(np.square(model.predict(shown.observations[:1])[0] - shown.actions[0]).mean())

    model = make(kind, demonstrations=shown, learning_rate=0.01).learn(200)
    model.save(tmp_path / "model.zip")
    loaded = kind.load(tmp_path / "model.zip", env=gym.make(ENV), demonstrations=shown, learning_rate=1e-5)
    loaded.learn(100, reset_num_timesteps=False)
    assert error(loaded) < 0.02 and error(make(kind, demonstrations=shown)) > 0.1


@pytest.mark.parametrize("gets_env", ["with load", "later"])
def test_a_loaded_agent_learns_new_demonstrations_in_the_units_it_was_made_for(gets_env: str, tmp_path: Path) -> None:
    """Their spread is another one. What is learned is what is played."""
    rng = np.random.default_rng(0)

    def shown(scale: float) -> Demonstrations:
        observations = rng.normal(0.0, scale, (200, 3))
        return demonstrated(np.clip(observations[:, :1], -2, 2), observations, [0, 50, 100, 150])

    model = make(demonstrations=shown(1.0), policy_kwargs={"net_arch": [32]}, learning_rate=0.01).learn(200)
    model.save(tmp_path / "model.zip")
    new = shown(0.1)
    keywords: dict[str, Any] = {"env": gym.make(ENV)} if gets_env == "with load" else {}
    loaded = BC.load(tmp_path / "model.zip", demonstrations=new, learning_rate=1e-3, device="cpu", **keywords)
    if gets_env == "later":
        loaded.set_env(make_vec_env(ENV))
    loaded.learn(300)
    error = np.square(loaded.predict(new.observations)[0] - new.actions).mean() / new.actions.var()
    assert error < 0.1


def test_a_saved_agent_names_its_demonstrations_as_they_were_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    record(ENV).save("mine.npz")
    make(demonstrations=Path("mine.npz")).save("cloned")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    assert BC.load("../cloned", device="cpu").demonstrations == "mine.npz"  # to be played it needs none
    with pytest.raises(FileNotFoundError, match=r"at mine.npz .*; load\(path, env=env"):
        BC.load("../cloned", env=gym.make(ENV), device="cpu")
    assert BC.load("../cloned", env=gym.make(ENV), demonstrations="../mine.npz", device="cpu").learn(1).num_timesteps == 1


def test_two_runs_with_one_seed_are_equal() -> None:
    first, second = (make(BCRNN, input_noise=0.1).learn(10).policy.state_dict() for _ in range(2))
    assert all(th.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (BC, {"demonstrations": None}, "demonstrations=None: BC learns from demonstrations alone"),
        (BC, {"batch_size": 0}, "batch_size=0 must be at least 1"),
        (BC, {"input_noise": float("nan")}, "input_noise=nan must be a finite number"),
        (BC, {"n_demonstrations": 99}, "n_demonstrations=99.*: n_episodes must be"),
        (BCRNN, {"policy_kwargs": {"hidden_size": 0}}, "hidden_size=0 must be at least 1"),
        (
            BC,
            {"env": VecNormalize(make_vec_env(ENV))},
            r"VecNormalize\(norm_obs=True\): BC normalizes by the demonstrations",
        ),
    ],
)
def test_what_it_cannot_learn_from_is_refused(kind: type[BC], options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kind("MlpPolicy", **{"env": ENV, "demonstrations": record(ENV), "device": "cpu", **options})


def test_an_offline_method_is_evaluated_at_every_interval_and_others_before_their_first_step(tmp_path: Path) -> None:
    """ActPC also at step 0, after BC, or in five episodes at most where it has none; where a gate deploys a policy, the actor
    plays as many once it differs from it."""
    steps, episodes = {}, {}

    def counted(model: Any, envs: Any, n_episodes: int, seed: int) -> Any:
        episodes[name].append(n_episodes)
        return play_episodes(model, envs, n_episodes, seed)

    kinds = {
        "bc": ("bc", {}),
        "untrained": ("actpc", {"guidance": "none"}),
        "cloned": ("actpc", {"guidance_kwargs": {"bc_updates": 2}}),
        "td3": ("td3", {"bc_steps": 2}),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sb3_actpc.experiments.runs.evaluation.play_episodes", counted)
        for name, (algo, settings) in kinds.items():
            episodes[name] = []
            few = {"n_timesteps": 30, "eval_freq": 10, "eval_episodes": 6, "checkpoint_freq": 0, "progress": False}
            output, settings = str(tmp_path / name), {"batch_size": 4, **settings}
            train_run(Run(env="SparseReacher-v5", algo=algo, output=output, settings=settings, **few))
            with open(tmp_path / name / "progress.csv", encoding="utf-8") as file:
                steps[name] = [int(row["timesteps"]) for row in csv.DictReader(file)]
    assert steps == {"bc": [10, 20, 30], "untrained": [0, 10, 20, 30], "cloned": [0, 10, 20, 30], "td3": [0, 10, 20, 30]}
    assert episodes == {
        "bc": [6] * 3,
        "untrained": [5, 6, 6, 6],
        "cloned": [6] * 7,
        "td3": [6] * 4,
    }  # deployed policy, then actor; after BC they are the same


@pytest.mark.parametrize("kind", [BC, BCRNN])
def test_a_dict_of_observations_is_joined_in_the_order_of_its_space(kind: type[BC], tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    env = gym.make("GoalReacher-v5")
    shown = Demonstrations.record(lambda _: rng.uniform(-0.1, 0.1, 2), env, 3, only_successes=False)
    model = make(kind, env=env, demonstrations=shown).learn(20)
    observation, _ = env.reset(seed=1)
    joined = np.concatenate([observation[key].ravel() for key in env.observation_space])
    model.save(tmp_path / "model")
    played = kind.load(tmp_path / "model")
    shuffled = dict(reversed(observation.items()))
    action, _ = played.predict(shuffled, deterministic=True)
    inputs = model.policy.normalized(joined[None])
    expected = model.policy(inputs[:, None] if kind is BCRNN else inputs).detach().numpy().reshape(-1)
    assert action == pytest.approx(model.policy.unscale_action(expected.clip(-1, 1)), abs=1e-6)
