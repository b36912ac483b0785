"""What an environment holds comes back as it was, or its episode starts again and the reason is said."""

import functools
import json
import random
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeObservation, NormalizeReward, TransformReward
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_actpc.checkpoints.encoding import Decoder, Encoder
from sb3_actpc.experiments.runs.evaluation import EpisodeLog
from tests.actpc.envs import CountingEnv
from tests.checkpoints.runs import assert_same, learn_in_two, learn_straight, log_rows, make_actpc


def go_on(make: Callable[[], gym.Env], change: Callable[[Any], Any]) -> Any:
    """An environment made again, with what was written of another one in its first episode, after a change; the reason why its
    episode starts again, or nothing."""
    first, encoder = DummyVecEnv([make]), Encoder()
    first.seed(1)
    first.reset()
    change(first.envs[0])
    record, nodes = json.loads(json.dumps([encoder.encode(first), encoder.nodes]))
    decoder = Decoder(nodes, {name: array.copy() for name, array in encoder.arrays.items()})
    return decoder.decode(record, DummyVecEnv([make])).envs[0], "; ".join(decoder.lost)


class Stage(Enum):
    REACH = 1
    GRASP = 2


class Scale:
    """A callable object."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, reward: Any) -> float:
        self.calls += 1
        return float(reward) + 0.01 * self.calls


class WithoutModule(type):
    """The type of a class that says not where it is from, as those of SWIG's libraries (Box2D)."""

    @property
    def __module__(cls) -> str:  # type: ignore[override]
        raise AttributeError("__module__")


class Pointer(metaclass=WithoutModule):
    __slots__ = ()


class StagedEnv(CountingEnv):
    """Its behaviour is one of its methods, and a function."""

    def __init__(self) -> None:
        super().__init__()
        self.stage, self.act, self.score = Stage.REACH, self.reset, lambda reward: 1.0 * reward


class Noisy(gym.Wrapper):
    """Draws from the environment's generator."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.rng = env.unwrapped.np_random


def test_values_come_back_with_their_types_and_are_shared_as_they_were() -> None:
    """Also by two layers, where it was another thing when made."""
    array, numbers, rng = np.zeros(3), [float("inf"), np.float32(0.1), np.int64(3), 2**70], random.Random(3)
    held: dict[str, Any] = {"stage": Stage.GRASP, "visits": Counter(a=2), "names": frozenset("ab"), "numbers": numbers}
    held["tree"] = OrderedDict(b=(1, numbers))
    loop: list[Any] = [array]
    loop.append(loop)

    def change(env: Any) -> None:
        inner = env.unwrapped
        vars(inner).update(held, array=array, loop=loop, act=inner.step, next=deque([inner.reset]))
        vars(inner).update(random=rng, same=rng, two=np.random.RandomState(3), of_wrapper=env.rng)

    env, reason = go_on(lambda: Noisy(StagedEnv()), change)
    inner = env.unwrapped
    assert not reason
    assert (inner.act, list(inner.next)) == (inner.step, [inner.reset])
    for name, value in held.items():
        assert getattr(inner, name) == value and type(getattr(inner, name)) is type(value)
    assert [type(one) for one in inner.numbers] == [float, np.float32, np.int64, int]
    assert inner.tree["b"][1] is inner.numbers and inner.loop[0] is inner.array and inner.loop[1] is inner.loop
    assert inner.of_wrapper is env.rng is not inner.np_random
    assert inner.same is inner.random and inner.random.random() == random.Random(3).random()
    assert inner.two.random() == np.random.RandomState(3).random()


LOST = [lambda reward: 2.0 * reward, abs, Scale, Scale(), iter([1]), np.array(["a"]), CountingEnv(), Pointer()]
KINDS = ["function", "builtin", "class", "object", "iterator", "texts", "environment", "pointer"]


@pytest.mark.parametrize("held", LOST, ids=KINDS)
def test_what_calls_for_code_is_lost_unless_the_new_environment_has_the_same(held: Any) -> None:
    for score in (held, [held]):
        assert "StagedEnv.score: " in go_on(StagedEnv, lambda env: setattr(env, "score", score))[1]  # noqa: B023


def test_a_view_of_the_simulators_memory_is_lost() -> None:
    make = functools.partial(gym.make, "HalfCheetah-v5")
    _, reason = go_on(make, lambda env: vars(env.unwrapped).update(joints=env.unwrapped.data.qpos[1:]))
    assert "joints: an array that shares memory" in reason


def closure() -> Callable[[Any], float]:
    rng, calls = np.random.default_rng(1), 0

    def shifted(reward: Any) -> float:
        nonlocal calls
        calls += 1
        return float(reward) + rng.normal() + 0.01 * calls

    return shifted


def normalized(inner: Callable[[], gym.Env], change: Callable[[Any], float]) -> gym.Env:
    """All that gymnasium's wrappers know of observations and returns."""
    return NormalizeReward(NormalizeObservation(TransformReward(inner(), change)))  # type: ignore[arg-type]


@pytest.mark.filterwarnings("error:.*cannot be restored within")
@pytest.mark.parametrize("make_function", [closure, Scale])
def test_what_an_environment_remembers_goes_on(tmp_path: Path, make_function: Callable[[], Any]) -> None:
    """Stopped in the third episode, after two."""
    make = lambda: make_actpc(lambda: normalized(CountingEnv, make_function()))  # noqa: E731
    straight = learn_straight(make, tmp_path / "straight", 60)
    assert_same(straight, learn_in_two(make, tmp_path / "resumed", 60, 33))


class OpaqueEnv(CountingEnv):
    """Holds what nobody can store, and reports a dense reward of 1 a step."""

    def __init__(self) -> None:
        super().__init__()
        self.handle = iter([1])

    def step(self, action: Any) -> Any:
        *result, info = super().step(action)
        return (*result, {**info, "dense_reward": 1.0})


def test_layers_that_can_be_stored_go_on_beside_one_that_cannot() -> None:
    env, reason = go_on(lambda: normalized(OpaqueEnv, closure()), lambda env: [env.step(np.zeros(2)) for _ in range(3)])
    assert reason == "OpaqueEnv.handle: a builtins.list_iterator cannot be stored as plain data"
    assert env.return_rms.count == pytest.approx(3, abs=0.01) and env.env.obs_rms.count == pytest.approx(4, abs=0.01)


def test_an_episode_that_starts_again_is_logged_without_its_lost_beginning(tmp_path: Path) -> None:
    """Each step is worth 1."""
    logs = [EpisodeLog(tmp_path, lambda: 0.0) for _ in range(2)]
    logs[0].begin_file()
    made = iter(logs)
    with pytest.warns(UserWarning, match="all episodes start again"):
        learn_in_two(lambda: make_actpc(OpaqueEnv), tmp_path, 60, 33, lambda: [next(made)])
    rows = log_rows(tmp_path / "episodes.csv")
    assert len(rows) == 7
    assert [float(row["dense_return"]) for row in rows] == [float(row["length"]) for row in rows]
