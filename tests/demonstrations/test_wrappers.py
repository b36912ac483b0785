"""Demonstrations in other units than the agent's: wrappers around the same task are compared, and plain ones are no matter."""

import dataclasses
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces, wrappers
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper, VecMonitor, VecNormalize

from sb3_actpc import ActPC
from sb3_actpc.baselines import BC, TD3Demo
from sb3_actpc.demonstrations import Demonstrations, fit_demonstrations, shipped_demonstrations
from tests.recordings import record

Wrap = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]
TASKS = ["Pendulum-v1", "SparseReacher-v5", "GoalReacher-v5"]


class Logger(gym.Wrapper[Any, Any, Any, Any]):
    """Overrides step and changes nothing."""

    def step(self, action: Any) -> Any:
        self.last = super().step(action)
        return self.last


class Negated(gym.Wrapper[Any, Any, Any, Any]):
    """An action wrapper that is none by its class."""

    def step(self, action: Any) -> Any:
        return self.env.step(-action)


class HoldsFile(gym.Wrapper[Any, Any, Any, Any]):
    """Holds the task itself and a file, as some loggers do."""

    def __init__(self, env: gym.Env[Any, Any], path: str) -> None:
        super().__init__(env)
        self.task, self.file = env.unwrapped, open(path, "a")

    def close(self) -> None:
        self.file.close()
        super().close()


def scaled(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """Observations times 100, also in a Dict."""
    space: Any = env.observation_space

    def change(one: Any) -> Any:
        return {key: part * 100 for key, part in one.items()} if isinstance(one, dict) else one * 100

    boxes: dict[str, spaces.Space[Any]] = {
        key: spaces.Box(-np.inf, np.inf, part.shape) for key, part in getattr(space, "spaces", {}).items()
    }
    larger = spaces.Dict(boxes) if boxes else spaces.Box(-np.inf, np.inf, space.shape)
    return wrappers.TransformObservation(env, change, larger)


def rescaled(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return wrappers.RescaleAction(env, np.float32(-4.0), np.float32(4.0))


def with_the_same_bounds(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    space: Any = env.action_space
    return wrappers.RescaleAction(env, space.low, space.high)


UNITS: dict[str, Wrap] = {
    "observations": scaled,
    "rescaled actions": rescaled,
    "negated actions": lambda env: wrappers.TransformAction(env, lambda action: -action, env.action_space),
    "negated, by no known class": Negated,
    "running mean": lambda env: wrappers.NormalizeObservation(env),
    "below others": lambda env: Monitor(wrappers.TimeLimit(Negated(env), 50)),
}
REWARDS: dict[str, Wrap] = {
    "rewards": lambda env: wrappers.TransformReward(env, lambda reward: 10 * float(reward) - 1),
    "rewards times ten": lambda env: wrappers.TransformReward(env, lambda reward: 10 * float(reward)),
    "clipped rewards": lambda env: wrappers.ClipReward(env, -1.0, 1.0),
    "normalized rewards": lambda env: wrappers.NormalizeReward(env),
}
SAME: dict[str, Wrap] = {
    "nothing": lambda env: env,
    "monitor": Monitor,
    "statistics": lambda env: wrappers.RecordEpisodeStatistics(env),
    "time limit": lambda env: wrappers.TimeLimit(env, 999),
    "logger": Logger,
    "clipped actions": lambda env: wrappers.ClipAction(env),
    "another type": lambda env: wrappers.DtypeObservation(env, np.float32),
    "the same bounds": with_the_same_bounds,
    "all of them": lambda env: Monitor(Logger(wrappers.RecordEpisodeStatistics(wrappers.TimeLimit(env, 999)))),
}


def fitted(shown: Demonstrations, env_id: str, wrap: Wrap) -> Demonstrations:
    env = DummyVecEnv([lambda: wrap(gym.make(env_id))] * 2)
    try:
        return fit_demonstrations(shown, env, env.observation_space, env.action_space)
    finally:
        env.close()


def without_metadata(shown: Demonstrations) -> Demonstrations:
    """As one's own arrays are: nothing says behind which wrappers they were recorded."""
    return dataclasses.replace(shown, metadata={})


@pytest.mark.parametrize("env_id", TASKS)
@pytest.mark.parametrize("name", UNITS)
def test_demonstrations_in_other_units_are_refused_or_warned_of(name: str, env_id: str) -> None:
    if env_id == "GoalReacher-v5" and name == "running mean":
        pytest.skip("of Dict observations there is none")
    shown = record(env_id)
    with pytest.raises(ValueError, match=r"recorded behind no wrapper, the agent learns behind .* record them in"):
        fitted(shown, env_id, UNITS[name])
    with pytest.warns(UserWarning, match="behind wrappers that are not known, the agent learns behind"):
        fitted(without_metadata(shown), env_id, UNITS[name])


@pytest.mark.parametrize("env_id", TASKS)
@pytest.mark.parametrize("name", REWARDS)
def test_other_rewards_are_warned_of(name: str, env_id: str) -> None:
    for shown in (record(env_id), without_metadata(record(env_id))):
        with pytest.warns(UserWarning, match=r"the agent learns behind .* \(changes rewards\): record them in"):
            fitted(shown, env_id, REWARDS[name])


@pytest.mark.filterwarnings("error", "ignore:.*precision lowered")
@pytest.mark.parametrize("env_id", TASKS)
@pytest.mark.parametrize("name", SAME)
def test_wrappers_that_change_nothing_raise_no_alarm(name: str, env_id: str) -> None:
    if env_id == "GoalReacher-v5" and name == "another type":
        pytest.skip("of Dict observations there is none")
    for shown in (record(env_id), without_metadata(record(env_id))):
        fitted(shown, env_id, SAME[name])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("wrap", [*UNITS.values(), *REWARDS.values()])
def test_demonstrations_recorded_behind_the_same_wrappers_fit(wrap: Wrap) -> None:
    with wrap(gym.make("Pendulum-v1", max_episode_steps=9)) as env:
        shown = Demonstrations.record(lambda _: np.zeros(1, np.float32), env, 1)
    fitted(shown, "Pendulum-v1", wrap)
    assert all(name.isidentifier() or "(" in name for name in shown.metadata["wrappers"])


def test_wrappers_with_other_numbers_and_missing_ones_are_named() -> None:
    def twice(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        return wrappers.RescaleAction(env, np.float32(-1.0), np.float32(1.0))

    with twice(gym.make("Pendulum-v1", max_episode_steps=9)) as env:
        shown = Demonstrations.record(lambda _: np.ones(1, np.float32), env, 1)
    with pytest.raises(
        ValueError, match=r"behind RescaleAction\(max_action=1.0.*the agent learns behind RescaleAction\(max_action=4.0"
    ):
        fitted(shown, "Pendulum-v1", rescaled)
    with pytest.warns(UserWarning, match=r"recorded behind RescaleAction\(.*the agent learns behind no wrapper"):
        fitted(shown, "Pendulum-v1", lambda env: env)


@pytest.mark.filterwarnings("error")
def test_what_the_user_says_settles_it() -> None:
    shown = record("Pendulum-v1")
    with pytest.raises(ValueError, match=r'say so: dataclasses.replace.*"wrappers": \[\'Negated\'\]'):
        fitted(shown, "Pendulum-v1", Negated)
    said = dataclasses.replace(shown, metadata={**shown.metadata, "wrappers": ["Negated"]})
    fitted(said, "Pendulum-v1", Negated)


@pytest.mark.filterwarnings("error")
def test_the_agents_environment_is_left_alone(tmp_path: Path) -> None:
    """Neither stepped nor reset; what cannot be copied is warned of by its name."""
    shown = record("Pendulum-v1")
    env = DummyVecEnv([lambda: Logger(gym.make("Pendulum-v1"))])
    env.seed(3)
    env.reset()
    inner: Any = env.envs[0].unwrapped
    before = inner.np_random.bit_generator.state, inner.state.tolist()
    fit_demonstrations(shown, env, env.observation_space, env.action_space)
    assert (inner.np_random.bit_generator.state, inner.state.tolist()) == before
    assert not hasattr(env.envs[0], "last")
    with pytest.warns(UserWarning, match=r"the agent learns behind HoldsFile: record"):
        fitted(shown, "Pendulum-v1", lambda env: HoldsFile(env, str(tmp_path / "log")))
    env.close()


class Scaling(VecEnvWrapper):
    def reset(self) -> Any:
        return self.venv.reset() * 100  # type: ignore[operator]

    def step_wait(self) -> Any:
        observations, *rest = self.venv.step_wait()
        return observations * 100, *rest  # type: ignore[operator]


def test_vectorised_wrappers_of_others_are_named_and_sb3s_are_not() -> None:
    shown = record("Pendulum-v1")
    inner = DummyVecEnv([lambda: gym.make("Pendulum-v1")])
    usual: list[VecEnv] = [VecMonitor(inner), VecNormalize(inner), VecNormalize(VecMonitor(inner))]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for env in usual:
            fit_demonstrations(shown, env, env.observation_space, env.action_space)
    with pytest.warns(UserWarning, match="the agent learns behind Scaling: record"):
        fit_demonstrations(shown, Scaling(inner), inner.observation_space, inner.action_space)
    inner.close()


def make_negated() -> gym.Env[Any, Any]:
    return Monitor(Negated(gym.make("Pendulum-v1")))


def make_usual() -> gym.Env[Any, Any]:
    return Monitor(wrappers.RecordEpisodeStatistics(gym.make("Pendulum-v1")))


def test_wrappers_in_other_processes_are_known_by_their_names() -> None:
    shown = record("Pendulum-v1")
    for make, is_usual in ((make_negated, False), (make_usual, True)):
        env = SubprocVecEnv([make], start_method="fork")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fit_demonstrations(shown, env, env.observation_space, env.action_space)
        said = [str(one.message) for one in caught if "the agent learns behind Negated" in str(one.message)]
        assert bool(said) != is_usual
        env.close()


@pytest.mark.parametrize("kind", [ActPC, TD3Demo, BC])
def test_every_algorithm_refuses_them(kind: Any) -> None:
    with pytest.raises(ValueError, match="the agent learns behind Negated"):
        model = kind("MlpPolicy", Negated(gym.make("Pendulum-v1")), demonstrations=record("Pendulum-v1"), device="cpu")
        model.learn(1)


@pytest.mark.filterwarnings("error", "ignore:.*out of date")
@pytest.mark.parametrize(
    "env_id", ["SparseHopper-v5", "SparseHopper-v4", "SparseReacher-v5", "GoalReacher-v5", "GoalHopper-v5"]
)
def test_the_packages_demonstrations_fit_its_tasks(env_id: str) -> None:
    shown = Demonstrations.load(shipped_demonstrations(env_id.replace("Goal", "Sparse"))).select(1)
    fitted(shown, env_id, Monitor)


def test_the_packages_demonstrations_are_known_to_be_recorded_behind_no_wrapper() -> None:
    with pytest.raises(ValueError, match="recorded behind no wrapper, the agent learns behind TransformObservation"):
        fitted(Demonstrations.load(shipped_demonstrations("SparseReacher-v5")), "SparseReacher-v5", scaled)


def test_the_time_limit_that_rl_zoo3_puts_in_raises_no_alarm():
    """It is there as soon as rl_zoo3 is imported, whoever imports it."""
    code = (
        "import warnings; warnings.simplefilter('error', UserWarning)\n"
        "import rl_zoo3.gym_patches, gymnasium as gym, numpy as np\n"
        "from sb3_actpc.demonstrations.wrappers import Wrapping, wrapping_of\n"
        "env = gym.wrappers.TimeLimit(gym.make('Pendulum-v1'), 9)\n"
        "assert type(env).__name__ == 'PatchedTimeLimit'\n"
        "assert wrapping_of(env, np.zeros((10, 1))) == Wrapping()\n"
    )
    pytest.importorskip("rl_zoo3")
    subprocess.run([sys.executable, "-W", "ignore::DeprecationWarning", "-c", code], check=True)
