"""Generated bad inputs: constructor and command line answer with one clear error, or they work."""

import inspect
import math
import traceback
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from gymnasium.envs.registration import EnvSpec
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env

from sb3_actpc import ActPC
from sb3_actpc.actpc.policies import CIRCUIT_KEYWORDS, ActPCPolicy
from sb3_actpc.cli import main
from sb3_actpc.utils.arguments import CIRCUITS
from tests.actpc.envs import CountingEnv, demonstrations
from tests.checkpoints.runs import ACTPC, SHORT_WARM_UP

HUGE = 10**30
# these mean "go on for so long" or "from so late on": nothing is wrong with a large one
LONG = {"prior_updates", "bc_updates", "gradient_steps", "n_settling_steps", "learning_starts", "critic_warmup"}
LONG_OPTIONS = ("--steps", "--eval-episodes", "--episodes", "--rounds")


def generated(n_examples: int) -> Callable[[Any], Any]:
    """The same examples every time, none of which may take long."""
    return settings(
        max_examples=n_examples,
        derandomize=True,
        database=None,
        deadline=timedelta(seconds=20),
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


def assert_clear(error: Exception, *names: str) -> None:
    """It was raised by this package (or by SB3), says which value is wrong, and is one short paragraph."""
    text, source = str(error), traceback.extract_tb(error.__traceback__)[-1].filename
    assert any(package in source for package in ("sb3_actpc", "stable_baselines3")), source
    assert any(name in text for name in names), f"{text!r} names none of {names}"
    assert "\n" not in text and len(text) < 2000


# ---------------------------------------------------------------------- the constructor

NUMBERS = st.sampled_from([math.nan, math.inf, -math.inf, -1, 0, 1, 2, 0.5, -0.5, 2.5, 1e300, HUGE, -HUGE, 10**400])
TEXTS = st.sampled_from(["", "x", "cpu", "cuda:99", "auto", "None", "nowhere.npz", "\0", "tanh", "\u221e"])
OBJECTS = st.sampled_from(
    [None, True, False, b"x", 1j, object(), int, len, math.sqrt, th.zeros(2), np.zeros(2), np.array("x"), np.float32("nan")]
)
SCALARS = st.one_of(NUMBERS, TEXTS, OBJECTS)
VALUES = st.recursive(
    SCALARS,
    lambda parts: st.one_of(st.lists(parts, max_size=3), st.tuples(parts, parts), st.dictionaries(TEXTS, parts, max_size=2)),
    max_leaves=4,
)
CIRCUIT_VALUES = st.one_of(SCALARS, st.sampled_from(["learned", "tied", "krylov", "state", "column_norm", "iterative"]))
OF_ONE_CIRCUIT = sorted({*CIRCUIT_KEYWORDS, "net_arch", "learning_rate", "batch_size", "n_inputs", "hiden"})
OF_THE_POLICY = sorted({*inspect.signature(ActPCPolicy.__init__).parameters, "activation_fn"} - {"self"})
OF_THE_BUFFER = ["combined", "self_imitation_size", "n_sampled_goal", "handle_timeout_termination", "history", "n_steps", "x"]
ARCHITECTURES = st.one_of(VALUES, st.lists(st.one_of(st.integers(-1, 9), SCALARS), max_size=3))
KEYWORDS = sorted(set(inspect.signature(ActPC.__init__).parameters) - {"self", "_init_setup_model"})
KEYS_OF = {"policy_kwargs": OF_THE_POLICY, "replay_buffer_kwargs": OF_THE_BUFFER, "circuit_kwargs": OF_ONE_CIRCUIT}
KEYS_OF |= {f"{circuit}_kwargs": OF_ONE_CIRCUIT for circuit in CIRCUITS}


def keyword_values(name: str) -> st.SearchStrategy[Any]:
    """Values for one keyword of the constructor, most of them bad."""
    if name in KEYS_OF:
        keys = st.sampled_from(KEYS_OF[name])
        return st.one_of(VALUES, keys.flatmap(lambda key: st.fixed_dictionaries({key: keyword_values(key)})))
    if name == "net_arch":
        return ARCHITECTURES
    return CIRCUIT_VALUES if name in OF_ONE_CIRCUIT else VALUES


def keys_of(value: Any) -> list[str]:
    """Those of nested mappings."""
    parts = value.items() if isinstance(value, dict) else ()
    return [name for key, part in parts for name in (str(key), *keys_of(part))]


def is_long(name: str, value: Any) -> bool:
    """Whether training would go on for ever, as asked."""
    if isinstance(value, dict):
        return any(is_long(str(key), part) for key, part in value.items())
    return name in LONG and isinstance(value, (int, float)) and value > 100


@given(st.sampled_from(KEYWORDS).flatmap(lambda name: st.tuples(st.just(name), keyword_values(name))))
@generated(300)
def test_the_constructor_names_what_is_wrong(keyword: tuple[str, Any]) -> None:
    """A bad value is refused by a ValueError, or does no harm to a short training."""
    name, value = keyword
    if is_long(name, value):
        return
    keywords = {"policy": "MlpPolicy", "env": make_vec_env(CountingEnv), **ACTPC, **SHORT_WARM_UP}
    keywords["demonstrations"] = demonstrations()
    inner = keys_of(value)
    try:
        ActPC(**{**keywords, name: value}).learn(14)
    except ValueError as error:
        if "not finite at step" not in str(error):
            assert_clear(error, name, *inner)
    except FileNotFoundError as error:
        assert name == "demonstrations"
        assert_clear(error, str(value))
    except gym.error.Error:  # no such task
        assert name == "env" and isinstance(value, str)


# ---------------------------------------------------------------------- the command line

WORDS = st.one_of(
    st.sampled_from(["nan", "inf", "-1", "0", "2", "1e400", "9" * 400, str(HUGE), "text", "", " ", "--", "[", "{a: 1}", "~"]),
    st.sampled_from(["!!python/name:os.system", "\u221e", "none", "shipped", ".", "/", "bad.yml", "bad.npz", "cuda:99", "\0"]),
    st.text(max_size=5),
)
SETTINGS = st.sampled_from([*KEYWORDS, "noise_type", "noise_std", "n_timesteps", "n_envs", "env_kwargs", "learing_rate"])
ASSIGNMENTS = st.one_of(WORDS, st.tuples(SETTINGS, WORDS).map("=".join))
OPTIONS = (
    "--steps --seed --eval-freq --eval-episodes --n-envs --threads --checkpoint-freq --env --algo --preset --demonstrations "
    "--device --output --resume --episodes --unknown --video --rounds"
).split()
ARGUMENTS = st.lists(
    st.one_of(
        st.tuples(st.sampled_from(OPTIONS), WORDS),
        st.tuples(st.sampled_from(["--set", "--env-kwarg"]), ASSIGNMENTS),
    ).map("=".join),
    max_size=2,
)
SMALL = ["--env=CountingEnv-v0", "--preset=small.yml", "--demonstrations=none", "--steps=12", "--eval-episodes=1"]
COMMANDS = st.one_of(
    ARGUMENTS.map(lambda more: ["train", *SMALL, "--no-progress", *more]),
    ARGUMENTS.map(lambda more: ["train", *more]),
    st.tuples(WORDS, ARGUMENTS).map(lambda words: ["evaluate", words[0], "--no-video", *words[1]]),
    st.tuples(st.sampled_from(["collect", "info"]), WORDS).map(lambda words: ["demos", *words]),
    st.lists(WORDS, max_size=3),
)


def preset_of(**settings: Any) -> bytes:
    return yaml.safe_dump({"default": settings}).encode()


ENTRIES = st.one_of(
    st.binary(max_size=40),
    st.dictionaries(SETTINGS, st.one_of(NUMBERS, TEXTS), max_size=2).map(lambda settings: preset_of(**settings)),
    st.sampled_from([b"", b"default:", b"default: []", b"[1]", b"default: {1: 2}"]),
)
TRAIN_BAD_PRESET = ["train", *SMALL, "--no-progress", "--preset=bad.yml"]


@given(COMMANDS, ENTRIES)
@example(TRAIN_BAD_PRESET, b"default: &a {policy_kwargs: *a}")
@example(TRAIN_BAD_PRESET, preset_of(n_envs=math.nan))
@example(TRAIN_BAD_PRESET, preset_of(replay_buffer_class="HerReplayBuffer"))
@example(TRAIN_BAD_PRESET, preset_of(policy_kwargs={"net_arch": [2**20, 2**20, 2**20]}))
@example(["train", *SMALL, "--no-progress", f"--n-envs={HUGE}"], b"")
@generated(60)
def test_the_command_line_answers_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], preset: bytes
) -> None:
    """It works, or there is one line (after argparse's usage) and an exit code. The task takes no time."""
    if any(word.partition("=")[0] in LONG_OPTIONS and word.endswith(f"={HUGE}") for word in arguments):
        return
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(gym.registry, "CountingEnv-v0", EnvSpec("CountingEnv-v0", entry_point=CountingEnv))
    small = {"settling": "scheduled", "learning_starts": 4, "batch_size": 4, "buffer_size": 50}
    Path("small.yml").write_bytes(preset_of(**small, policy_kwargs={"net_arch": [4]}))
    Path("bad.yml").write_bytes(preset)
    Path("bad.npz").write_bytes(preset)
    try:
        code = main(arguments)
    except SystemExit as stop:  # argparse's own answer
        code = int(stop.code or 0)
    errors = capsys.readouterr().err.strip()
    assert code in (0, 2)
    assert "Traceback" not in errors
    if code:
        assert errors.startswith("usage:") or errors.count("\n") == 0, errors
        assert "error:" in errors and len(errors) < 3000, errors
