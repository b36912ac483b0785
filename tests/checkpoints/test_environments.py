"""What an environment holds comes back as it was, or its episode starts again and the reason is said."""

import functools
import json
import random
import sys
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable
from enum import Enum, IntFlag
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeObservation, NormalizeReward, TransformReward
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_actpc.checkpoints.encoding import Decoder, Encoder
from sb3_actpc.checkpoints.simulators import capture_vec_env, restore_vec_env
from sb3_actpc.experiments.runs.episode_log import EpisodeLog
from tests.actpc.envs import CountingEnv
from tests.checkpoints.runs import assert_same, learn_in_two, learn_straight, log_rows, make_actpc


def go_on(make: Callable[[], gym.Env], change: Callable[[Any], None], before: Callable[[], None] = lambda: None) -> Any:
    """An environment made again, with what was written of another one in its first episode, after a change; the reason why its
    episode starts again, or nothing. ``before`` is called between writing and reading."""
    first, encoder = DummyVecEnv([make]), Encoder()
    first.seed(1)
    first.reset()
    change(first.envs[0])
    record, nodes = json.loads(json.dumps([capture_vec_env(first, encoder, "env"), encoder.nodes]))
    decoder = Decoder(nodes, {name: array.copy() for name, array in encoder.arrays.items()})
    before()
    second = DummyVecEnv([make])
    lost = restore_vec_env(second, record, decoder)
    return second.envs[0], lost[0][1] if lost else ""


def holding(**things: Any) -> Callable[[Any], None]:
    """Puts these into an environment."""
    return lambda env: vars(env.unwrapped).update(things)


class Stage(Enum):
    REACH = 1
    GRASP = 2


class Word(str, Enum):
    YES = "yes"


class Parts(IntFlag):
    LEFT = 1
    RIGHT = 2


class StagedEnv(CountingEnv):
    """Its behaviour is one of its methods, and a function."""

    def __init__(self) -> None:
        super().__init__()
        self.stage, self.act, self.score = Stage.REACH, self.reach, lambda reward: 1.0 * reward

    def reach(self) -> int:
        return self.count

    def grasp(self) -> int:
        return -self.count


LOOP: list[Any] = [1]
LOOP.append(LOOP)


def test_values_come_back_with_their_types() -> None:
    held: dict[str, Any] = {
        "stage": Stage.GRASP,
        "new": (Stage.GRASP, [Word.YES]),
        "parts": Parts.LEFT | Parts.RIGHT,
        "counts": {Stage.REACH: 2},
        "visits": Counter(a=2),
        "groups": defaultdict(list, {1: [2]}),
        "tree": OrderedDict(b=defaultdict(None)),
        "names": frozenset("ab"),
        "data": b"\0\xff",
        "numbers": [float("inf"), np.float32(0.1), np.int64(3), 2**70],
    }
    env, reason = go_on(StagedEnv, holding(**held, loop=LOOP, none=np.empty((2, 0), dtype=object)))
    assert not reason
    for name, value in held.items():
        assert getattr(env, name) == value and type(getattr(env, name)) is type(value)
    assert env.stage is Stage.GRASP and env.new[1][0] is Word.YES
    assert [type(one) for one in env.numbers] == [float, np.float32, np.int64, int] and env.loop[1] is env.loop
    assert env.none.shape == (2, 0) and env.none.dtype == object
    env.visits["new"] += 1
    env.groups["new"].append(1)
    with pytest.raises(KeyError):
        env.tree["b"]["new"]


def test_methods_of_the_environment_come_back() -> None:
    env, reason = go_on(StagedEnv, lambda env: vars(env).update(act=env.grasp, next=deque([env.reach, env.grasp]), count=3))
    assert not reason
    assert (env.act(), [act() for act in env.next]) == (-3, [3, -3])


class Named(dict):
    """Of the user's."""


LOST = {
    "a function": lambda reward: 2.0 * reward,
    "a builtin": abs,
    "a class": Named,
    "a partial": functools.partial(pow, 2),
    "another's method": Monitor(CountingEnv()).close,
    "a dictionary of a class of the user's": Named(),
    "a factory that is a function": defaultdict(lambda: 3),
    "texts": np.array(["a"]),
    "an environment in a list": CountingEnv(),
}


@pytest.mark.parametrize("kind", LOST)
def test_what_calls_for_code_is_lost_unless_the_new_environment_has_the_same(kind: str) -> None:
    held = LOST[kind]
    assert "score" in go_on(StagedEnv, holding(score=[held]))[1]
    assert isinstance(held, gym.Env) or "score" in go_on(StagedEnv, holding(score=held))[1]  # that would be a layer


def test_a_member_or_a_method_that_is_no_longer_there_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    def rename() -> None:
        monkeypatch.delattr(StagedEnv, "grasp")
        monkeypatch.setattr(sys.modules[__name__], "Stage", Enum("Stage", ["REACH"], qualname="Stage"))

    _, reason = go_on(StagedEnv, lambda env: vars(env).update(stage=Stage.GRASP, act=env.grasp), rename)
    assert "StagedEnv.stage: it was Stage.GRASP, which is not there now" in reason
    assert "StagedEnv.act: it was the method grasp" in reason


def test_what_is_held_twice_is_held_twice_again() -> None:
    array, numbers, rng = np.zeros(3), [1, 2], np.random.default_rng(5)
    held = {"a": array, "b": (array, numbers), "numbers": numbers, "rng": rng, "same_rng": rng, "more": [numbers, numbers]}
    env, reason = go_on(CountingEnv, holding(**held))
    assert not reason
    assert env.a is env.b[0] and env.numbers is env.b[1] is env.more[0] is env.more[1] and env.rng is env.same_rng
    assert env.numbers == [1, 2] and env.rng.random() == np.random.default_rng(5).random()


class Noisy(gym.Wrapper):
    """Draws from the environment's generator."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.rng = env.unwrapped.np_random


@pytest.mark.parametrize("is_shared", [True, False])
def test_a_generator_is_shared_by_layers_as_it_was(is_shared: bool) -> None:
    """When made both hold the same one; the first reset gives the environment another."""

    def change(env: Any) -> None:
        env.rng = env.unwrapped.np_random if is_shared else np.random.default_rng(9)
        env.unwrapped.other = env.rng

    env, reason = go_on(lambda: Noisy(CountingEnv()), change)
    assert not reason and (env.rng is env.unwrapped.np_random) is is_shared and env.unwrapped.other is env.rng
    first = np.random.default_rng(9).random()
    assert (env.rng.random() == first) is not is_shared
    assert env.unwrapped.np_random.random() != first


@pytest.mark.parametrize(
    "rng",
    [random.Random(3), np.random.RandomState(3), np.random.Generator(np.random.SFC64(3))],
    ids=["Random", "RandomState", "Generator"],
)
def test_every_generator_goes_on_and_is_shared(rng: Any) -> None:
    env, reason = go_on(CountingEnv, holding(one=rng, other=rng))
    assert not reason and env.one is env.other
    assert env.one.random() == rng.random()


def test_views_of_the_same_memory_are_views_again() -> None:
    array = np.arange(8.0).reshape(4, 2)
    env, reason = go_on(CountingEnv, holding(part=array[1:, ::-1], whole=array, turned=[array.T], column=array[:, 1]))
    assert not reason
    env.whole[2] = 50.0, 51.0
    assert env.part.tolist() == [[3.0, 2.0], [51.0, 50.0], [7.0, 6.0]]
    assert env.turned[0][:, 2].tolist() == [50.0, 51.0] and env.column[2] == 51.0


@pytest.mark.parametrize("name", ["fullpath", "new"])
def test_a_view_of_the_simulators_memory_is_lost(name: str) -> None:
    """Stored before and after the simulator."""
    make = functools.partial(gym.make, "HalfCheetah-v5")
    _, reason = go_on(make, lambda env: vars(env.unwrapped).update({name: env.unwrapped.data.qpos[1:]}))
    assert "shares memory" in reason


def normalized(inner: Callable[[], gym.Env] = CountingEnv) -> gym.Env:
    """All that gymnasium's wrappers know of observations and returns."""
    return NormalizeReward(NormalizeObservation(TransformReward(inner(), lambda reward: float(reward) + 0.5)))  # type: ignore[arg-type]


def test_gymnasiums_statistics_go_on_bit_for_bit(tmp_path: Path) -> None:
    make = lambda: make_actpc(normalized)  # noqa: E731
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
    def change(env: Any) -> None:
        for _ in range(3):
            env.step(np.zeros(2))

    env, reason = go_on(lambda: Monitor(normalized(OpaqueEnv), allow_early_resets=False), change)
    assert "handle: a builtins.list_iterator" in reason and "of OpaqueEnv the random generators alone go on" in reason
    assert env.env.return_rms.count == pytest.approx(3, abs=0.01) and env.env.env.obs_rms.count == pytest.approx(4, abs=0.01)
    assert env.unwrapped.count == 0
    env.reset()  # which the monitor allows


def test_an_episode_that_starts_again_is_logged_without_its_lost_beginning(tmp_path: Path) -> None:
    """Each step is worth 1."""
    logs: list[EpisodeLog] = []

    def log() -> list[Any]:
        logs.append(EpisodeLog(tmp_path, lambda: 0.0))
        if len(logs) == 1:
            logs[0].begin_file()
        return [logs[-1]]

    with pytest.warns(UserWarning, match="all episodes start again"):
        learn_in_two(lambda: make_actpc(OpaqueEnv), tmp_path, 60, 33, log)
    rows = log_rows(tmp_path / "episodes.csv")
    assert len(rows) == 7
    assert [float(row["dense_return"]) for row in rows] == [float(row["length"]) for row in rows]
