"""What an environment holds comes back as it was, or its episode starts again and the reason is said."""

import functools
import json
import random
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


def go_on(make: Callable[[], gym.Env], change: Callable[[Any], None]) -> tuple[Any, str]:
    """An environment made anew, with what was written of another one in its first episode, after a change; the reason why its
    episode starts again, or nothing."""
    first, encoder = DummyVecEnv([make]), Encoder()
    first.seed(1)
    first.reset()
    change(first.envs[0])
    record = json.loads(json.dumps(capture_vec_env(first, encoder, "env")))
    return put_back(make, record, Decoder({name: array.copy() for name, array in encoder.arrays.items()}, encoder.tensors))


def put_back(make: Callable[[], gym.Env], record: dict[str, Any], decoder: Decoder) -> tuple[Any, str]:
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


def test_members_of_enumerations_come_back() -> None:
    held = {
        "stage": Stage.GRASP,
        "new": (Stage.GRASP, [Word.YES]),
        "parts": Parts.LEFT | Parts.RIGHT,
        "counts": {Stage.REACH: 2},
    }
    env, reason = go_on(StagedEnv, holding(**held))
    assert not reason
    assert {name: getattr(env, name) for name in held} == held
    assert env.stage is Stage.GRASP and env.new[1][0] is Word.YES


def test_methods_of_the_environment_come_back() -> None:
    env, reason = go_on(StagedEnv, lambda env: vars(env).update(act=env.grasp, next=deque([env.reach, env.grasp]), count=3))
    assert not reason
    assert (env.act(), [act() for act in env.next]) == (-3, [3, -3])


def other_scores() -> list[Any]:
    return [lambda reward: 2.0 * reward, abs, int, functools.partial(pow, 2), Monitor(CountingEnv()).close]


@pytest.mark.parametrize("score", other_scores(), ids=["function", "builtin", "class", "object", "another's method"])
def test_what_calls_for_code_is_lost_unless_the_new_environment_has_the_same(score: Any) -> None:
    assert not go_on(StagedEnv, lambda env: None)[1]
    for held in (score, [score]):
        assert "score" in go_on(StagedEnv, holding(score=held))[1]


def test_a_member_or_a_method_that_is_no_longer_there_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    encoder, old = Encoder(), DummyVecEnv([StagedEnv])
    vars(old.envs[0]).update(stage=Stage.GRASP, act=old.envs[0].grasp)  # type: ignore[attr-defined]
    record = capture_vec_env(old, encoder, "env")
    monkeypatch.delattr(StagedEnv, "grasp")
    record["envs"][0]["layers"][0]["stage"]["member"] = "LIFT"
    _, reason = put_back(StagedEnv, record, Decoder(encoder.arrays, {}))
    assert "StagedEnv.stage: it was Stage.LIFT, which is not there now" in reason
    assert "StagedEnv.act: it was the method grasp" in reason


def test_dictionaries_stay_what_they_are() -> None:
    held: dict[str, Any] = {
        "visits": Counter(a=2),
        "groups": defaultdict(list, {1: [2]}),
        "tree": OrderedDict(b=defaultdict(None)),
        "names": frozenset("ab"),
    }
    env, reason = go_on(CountingEnv, holding(**held))
    assert not reason
    for name, value in held.items():
        assert getattr(env, name) == value and type(getattr(env, name)) is type(value)
    env.visits["new"] += 1
    env.groups["new"].append(1)
    with pytest.raises(KeyError):
        env.tree["b"]["new"]

    class Named(dict):
        """Of the user's."""

    assert "Named cannot be stored" in go_on(CountingEnv, holding(names=Named()))[1]
    assert "groups" in go_on(CountingEnv, holding(groups=defaultdict(lambda: 3)))[1]  # from nowhere


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


@pytest.mark.parametrize("kind", [random.Random, np.random.RandomState])
def test_older_generators_are_shared_too(kind: Any) -> None:
    rng = kind(3)
    env, reason = go_on(CountingEnv, holding(one=rng, other=rng))
    assert not reason and env.one is env.other


def test_views_of_the_same_memory_are_lost() -> None:
    array = np.zeros((4, 2))
    for other in (array[1:], array.T, array[:, 1]):
        for pair in ((array, other), (other, array)):
            assert (
                "which shares memory with another array" in go_on(CountingEnv, holding(one=pair[0], other=list(pair[1:])))[1]
            )
    env, reason = go_on(CountingEnv, holding(one=array[:, 0], other=array[:, 1]))
    assert not reason and env.one.shape == env.other.shape == (4,)


def test_a_view_of_the_simulators_memory_is_lost() -> None:
    make = functools.partial(gym.make, "HalfCheetah-v5")
    for name in ("fullpath", "new"):  # before and after the simulator
        assert (
            "shares memory"
            in go_on(make, lambda env, name=name: vars(env.unwrapped).update({name: env.unwrapped.data.qpos[1:]}))[1]
        )


def normalized(inner: Callable[[], gym.Env] = CountingEnv) -> gym.Env:
    """All that gymnasium's wrappers know of observations and returns."""
    return NormalizeReward(NormalizeObservation(TransformReward(inner(), lambda reward: float(reward) + 0.5)))  # type: ignore[arg-type]


def test_gymnasiums_statistics_go_on_bit_for_bit(tmp_path: Path) -> None:
    make = lambda: make_actpc(normalized)  # noqa: E731
    straight = learn_straight(make, tmp_path / "straight", 60)
    resumed = learn_in_two(make, tmp_path / "resumed", 60, 33)
    assert_same(straight, resumed)


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


def test_what_was_written_before_is_read() -> None:
    """Types by name alone, one list of pairs for every dictionary, no numbers of lost layers."""
    layer = {
        "act": {"left": "method"},
        "stage": {"left": "Stage"},
        "count": 4,
        "groups": {"dict": [[1, [2]]]},
        "pair": {"tuple": [1, 2]},
        "itself": {"layer": 0},
    }
    entry: dict[str, Any] = {"classes": ["StagedEnv"], "layers": [layer]}
    record = {"wrappers": [], "seeds": [[None], [{"dict": []}]], "envs": [entry]}

    def make() -> gym.Env:
        env = StagedEnv()
        vars(env).update(groups=defaultdict(list))
        return env

    env, reason = put_back(make, record, Decoder({}, {}))
    assert not reason and env.stage is Stage.REACH and env.act() == 4 and env.pair == (1, 2) and env.itself is env
    assert env.groups == {1: [2]} and env.groups.default_factory is list
    entry["reason"] = "it was so"
    env, reason = put_back(make, record, Decoder({}, {}))
    assert reason.startswith("it was so; of StagedEnv") and env.count == 0
