"""Generated bad inputs: the constructor answers with one clear error, or it works."""

import inspect
import math
import traceback
from datetime import timedelta
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env

from sb3_actpc import ActPC
from sb3_actpc.actpc.policies import CIRCUIT_KEYWORDS, ActPCPolicy
from sb3_actpc.utils.arguments import CIRCUITS
from tests.actpc.envs import CountingEnv, demonstrations
from tests.checkpoints.runs import ACTPC, SHORT_WARM_UP

HUGE = 10**30
# these mean "go on for so long" or "from so late on": nothing is wrong with a large one
LONG = {"prior_updates", "bc_updates", "gradient_steps", "n_settling_steps", "learning_starts", "critic_warmup"}


def assert_clear(error: Exception, *names: str) -> None:
    """It was raised by this package (or by SB3), says which value is wrong, and is one short paragraph."""
    text, source = str(error), traceback.extract_tb(error.__traceback__)[-1].filename
    assert any(package in source for package in ("sb3_actpc", "stable_baselines3")), source
    assert any(name in text for name in names), f"{text!r} names none of {names}"
    assert "\n" not in text and len(text) < 2000


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
@settings(
    max_examples=300,
    derandomize=True,
    database=None,
    deadline=timedelta(seconds=20),
    suppress_health_check=[HealthCheck.too_slow],
)
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
