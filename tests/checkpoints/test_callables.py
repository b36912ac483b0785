"""Everything that a callable or a class of an environment remembers is stored, or named."""

import functools
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TransformObservation, TransformReward

from tests.actpc.envs import CountingEnv
from tests.checkpoints.runs import assert_same, learn_in_two, learn_straight, make_actpc

RNG = np.random.default_rng(0)
CALLS = 0


class ShiftedEnv(CountingEnv):
    """Adds to each reward what a callable returns."""

    def __init__(self, shift: Callable[[], float]) -> None:
        super().__init__()
        self.shift = shift

    def step(self, action: Any) -> Any:
        observation, reward, *rest = super().step(action)
        return observation, reward + self.shift(), *rest


def closure() -> Callable[[], float]:
    rng = np.random.default_rng(1)
    return lambda: rng.normal()


def counter() -> Callable[[], float]:
    calls = 0

    def shift() -> float:
        nonlocal calls
        calls += 1
        return 0.01 * calls

    return shift


def closure_in_a_closure() -> Callable[[], float]:
    count = counter()
    return lambda: 2.0 * count()


def recursive_function() -> Callable[[], float]:
    seen = [0]

    def shift(depth: int = 2) -> float:
        seen[0] += 1
        return shift(depth - 1) if depth else 0.01 * seen[0]

    return shift


def defaults() -> Callable[[], float]:
    def shift(seen: list[int] = [0], *, rng: Any = np.random.default_rng(2)) -> float:  # noqa: B006, B008
        seen[0] += 1
        return rng.normal() + 0.01 * seen[0]

    return shift


def attribute() -> Callable[[], float]:
    def shift() -> float:
        shift.calls += 1  # type: ignore[attr-defined]
        return 0.01 * shift.calls  # type: ignore[attr-defined]

    shift.calls = 0  # type: ignore[attr-defined]
    return shift


def variables_of_the_module() -> Callable[[], float]:
    global CALLS, RNG
    CALLS, RNG = 0, np.random.default_rng(6)

    def shift() -> float:
        global CALLS
        CALLS += 1
        return RNG.normal() + 0.01 * CALLS

    return shift


def transformed_observation() -> gym.Env:
    last = np.zeros(3)

    def smooth(observation: np.ndarray) -> np.ndarray:
        nonlocal last
        last = 0.5 * last + 0.5 * observation
        return last.astype(np.float32)

    env = CountingEnv()
    return TransformObservation(env, smooth, env.observation_space)


class CountingClass(CountingEnv):
    """Counts its steps, and draws, in the class."""

    n_steps: ClassVar[int] = 0
    rng: ClassVar[np.random.Generator] = np.random.default_rng(7)

    def step(self, action: Any) -> Any:
        observation, reward, *rest = super().step(action)
        type(self).n_steps += 1
        return observation, reward + 0.01 * self.n_steps + self.rng.normal(), *rest


def state_of_the_class() -> gym.Env:
    CountingClass.n_steps, CountingClass.rng = 0, np.random.default_rng(7)
    return CountingClass()


def class_in_a_function() -> gym.Env:
    rng = np.random.default_rng(8)

    class Inner(CountingEnv):
        def step(self, action: Any) -> Any:
            observation, reward, *rest = super().step(action)
            return observation, reward + rng.normal(), *rest

    return Inner()


def partial() -> Callable[[], float]:
    return functools.partial(lambda rng, scale: scale * rng.random(), np.random.RandomState(3), scale=0.5)


SHIFTS: list[Callable[[], Callable[[], float]]] = [
    closure, counter, closure_in_a_closure, recursive_function, defaults, attribute, variables_of_the_module, partial,
    lambda: np.random.default_rng(4).random, lambda: random.Random(5).random,
]  # fmt: skip
STORED = [
    *(lambda make=make: ShiftedEnv(make()) for make in SHIFTS),
    transformed_observation, state_of_the_class, class_in_a_function,
]  # fmt: skip
IDS = [*(make.__name__ for make in SHIFTS[:8]), "method of NumPy", "method of Python", *(one.__name__ for one in STORED[10:])]


@pytest.mark.filterwarnings("error:.*cannot be restored within its episode")
@pytest.mark.parametrize("make_env", STORED, ids=IDS)
def test_what_a_callable_remembers_goes_on(tmp_path: Path, make_env: Callable[[], gym.Env]) -> None:
    """Stopped in the third episode, after two."""
    make = lambda: make_actpc(make_env)  # noqa: E731
    straight = learn_straight(make, tmp_path / "straight", 70)
    assert_same(straight, learn_in_two(make, tmp_path / "resumed", 70, 41))


class Scale:
    """A callable object."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, reward: Any) -> float:
        self.calls += 1
        return float(reward) + 0.01 * self.calls

    def scaled(self, reward: Any) -> float:
        return self(reward)


class OfScale(CountingEnv):
    """Holds one in the class."""

    scale = Scale()


def numbers() -> Iterator[float]:
    n = 0
    while True:
        n += 1
        yield 0.01 * n


def over_an_iterator() -> gym.Env:
    drawn = numbers()
    return ShiftedEnv(lambda: next(drawn))


NAMED = {
    "callable object": (lambda: TransformReward(CountingEnv(), Scale()), "Scale cannot be stored"),
    "bound method": (lambda: TransformReward(CountingEnv(), Scale().scaled), "Scale cannot be stored"),
    "partial": (lambda: TransformReward(CountingEnv(), functools.partial(Scale())), "Scale cannot be stored"),
    "iterator in a closure": (over_an_iterator, "generator cannot be stored"),
    "next of an iterator": (lambda: ShiftedEnv(numbers().__next__), "method-wrapper cannot be stored"),
    "of a class": (OfScale, "OfScale.scale: a .*Scale cannot be stored"),
}


@pytest.mark.parametrize("kind", NAMED)
def test_what_cannot_be_stored_is_named(tmp_path: Path, kind: str) -> None:
    make_env, reason = NAMED[kind]
    with pytest.warns(UserWarning, match=f"environment 0 cannot be restored within its episode.*{reason}"):
        learn_in_two(lambda: make_actpc(make_env), tmp_path, 60, 33)
