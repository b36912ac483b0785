"""Demonstrations in other units than the agent's: the names of the wrappers around the task are compared."""

import dataclasses
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces, wrappers
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_actpc import ActPC
from sb3_actpc.baselines import BC, TD3Demo
from sb3_actpc.demonstrations import Demonstrations, fit_demonstrations, shipped_demonstrations
from tests.recordings import record

Wrap = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]


class Negated(gym.Wrapper[Any, Any, Any, Any]):
    """An action wrapper that is none by its class."""

    def step(self, action: Any) -> Any:
        return self.env.step(-action)


def rescaled(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return wrappers.RescaleAction(env, np.float32(-2.0), np.float32(2.0))


UNITS: list[Wrap] = [
    lambda env: wrappers.TransformObservation(env, lambda one: one * 100, spaces.Box(-999, 999, (3,))),
    rescaled,
    lambda env: Monitor(wrappers.TransformAction(env, lambda action: -action, env.action_space)),
    lambda env: wrappers.RecordEpisodeStatistics(wrappers.NormalizeObservation(env)),
]
OTHERS: list[Wrap] = [
    Negated,
    lambda env: wrappers.TransformReward(env, lambda reward: 10 * float(reward)),
    lambda env: wrappers.NormalizeReward(env),
]
PLAIN: list[Wrap] = [
    lambda env: env,
    lambda env: Monitor(wrappers.RecordEpisodeStatistics(wrappers.TimeLimit(env, 999))),
    lambda env: wrappers.ClipAction(wrappers.DtypeObservation(env, np.float32)),
]


def make_pendulum() -> gym.Env[Any, Any]:
    return gym.make("Pendulum-v1")


def fitted(shown: Demonstrations, wrap: Wrap, make: Callable[[], gym.Env[Any, Any]] = make_pendulum) -> Demonstrations:
    env = DummyVecEnv([lambda: wrap(make())] * 2)
    try:
        return fit_demonstrations(shown, env, env.observation_space, env.action_space)
    finally:
        env.close()


@pytest.fixture(scope="module")
def shown() -> Demonstrations:
    return record("Pendulum-v1")


@pytest.fixture(scope="module")
def unknown(shown: Demonstrations) -> Demonstrations:
    """As one's own arrays are: nothing says behind which wrappers they were recorded."""
    return dataclasses.replace(shown, metadata={})


@pytest.mark.parametrize("wrap", UNITS)
def test_demonstrations_in_other_units_are_refused_or_warned_of(
    wrap: Wrap, shown: Demonstrations, unknown: Demonstrations
) -> None:
    with pytest.raises(ValueError, match=r"recorded behind no wrapper, the agent learns behind .* record them in"):
        fitted(shown, wrap)
    with pytest.warns(UserWarning, match="behind wrappers that are not known, the agent learns behind"):
        fitted(unknown, wrap)


@pytest.mark.parametrize("wrap", OTHERS)
def test_other_wrappers_are_warned_of(wrap: Wrap, shown: Demonstrations, unknown: Demonstrations) -> None:
    for given in (shown, unknown):
        with pytest.warns(UserWarning, match=r"the agent learns behind .*: record them in"):
            fitted(given, wrap)


@pytest.mark.filterwarnings("error", "ignore:.*precision lowered")
@pytest.mark.parametrize("wrap", PLAIN)
def test_wrappers_that_change_nothing_raise_no_alarm(wrap: Wrap, shown: Demonstrations, unknown: Demonstrations) -> None:
    for given in (shown, unknown):
        fitted(given, wrap)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("wrap", [*UNITS, *OTHERS])
def test_demonstrations_recorded_behind_the_same_wrappers_fit(wrap: Wrap) -> None:
    with wrap(gym.make("Pendulum-v1", max_episode_steps=9)) as env:
        recorded = Demonstrations.record(lambda _: np.zeros(1, np.float32), env, 1)
    fitted(recorded, wrap)


def test_a_missing_wrapper_is_named() -> None:
    with rescaled(gym.make("Pendulum-v1", max_episode_steps=9)) as env:
        recorded = Demonstrations.record(lambda _: np.ones(1, np.float32), env, 1)
    with pytest.raises(ValueError, match="recorded behind RescaleAction, the agent learns behind no wrapper"):
        fitted(recorded, lambda env: env)


@pytest.mark.filterwarnings("error")
def test_what_the_user_says_settles_it(shown: Demonstrations) -> None:
    with pytest.raises(ValueError, match=r'say so: dataclasses.replace.*"wrappers": \[\'RescaleAction\'\]'):
        fitted(shown, rescaled)
    said = dataclasses.replace(shown, metadata={**shown.metadata, "wrappers": ["RescaleAction"]})
    fitted(said, rescaled)


def test_wrappers_in_other_processes_are_known_by_their_names(shown: Demonstrations) -> None:
    env = VecNormalize(SubprocVecEnv([lambda: Monitor(rescaled(gym.make("Pendulum-v1")))], start_method="fork"))
    with pytest.raises(ValueError, match="the agent learns behind RescaleAction: record"):
        fit_demonstrations(shown, env, env.observation_space, env.action_space)
    env.close()


def test_an_environment_that_does_not_name_its_wrappers_is_warned_of(shown: Demonstrations) -> None:
    class Silent(DummyVecEnv):
        def env_method(self, name: str, *args: Any, **options: Any) -> list[Any]:
            raise NotImplementedError

    env = Silent([make_pendulum])
    with pytest.warns(UserWarning, match="Silent does not name its wrappers .* recorded behind the same ones"):
        fit_demonstrations(shown, env, env.observation_space, env.action_space)
    env.close()


@pytest.mark.parametrize("kind", [ActPC, TD3Demo, BC])
def test_every_algorithm_refuses_them(kind: Any, shown: Demonstrations) -> None:
    with pytest.raises(ValueError, match="the agent learns behind RescaleAction"):
        model = kind("MlpPolicy", rescaled(gym.make("Pendulum-v1")), demonstrations=shown, device="cpu")
        model.learn(1)


@pytest.mark.filterwarnings("error", "ignore:.*out of date")
@pytest.mark.parametrize("env_id", ["SparseHopper-v5", "SparseHopper-v4", "GoalReacher-v5", "GoalHopper-v5"])
def test_the_packages_demonstrations_fit_its_tasks(env_id: str) -> None:
    """They are recorded behind no wrapper."""
    package = Demonstrations.load(shipped_demonstrations(env_id.replace("Goal", "Sparse"))).select(1)
    fitted(package, Monitor, lambda: gym.make(env_id))
    with pytest.raises(ValueError, match="recorded behind no wrapper, the agent learns behind RescaleAction"):
        fitted(package, lambda env: wrappers.RescaleAction(env, np.float32(-1.0), np.float32(1.0)), lambda: gym.make(env_id))


def test_the_time_limit_that_rl_zoo3_puts_in_raises_no_alarm(shown: Demonstrations) -> None:
    """It is there as soon as rl_zoo3 is imported, whoever imports it."""
    code = (
        "import warnings; warnings.simplefilter('error', UserWarning)\n"
        "import rl_zoo3.gym_patches, gymnasium as gym, numpy as np\n"
        "from sb3_actpc.demonstrations import Demonstrations\n"
        "env = gym.wrappers.TimeLimit(gym.make('Pendulum-v1'), 9)\n"
        "assert type(env).__name__ == 'PatchedTimeLimit'\n"
        "assert Demonstrations.record(lambda _: np.zeros(1), env, 1).metadata['wrappers'] == []\n"
    )
    pytest.importorskip("rl_zoo3")
    subprocess.run([sys.executable, "-W", "ignore::DeprecationWarning", "-c", code], check=True)
