"""Hooks in a training environment: calls are counted, and what an environment returns is a copy."""

import copy
import copyreg
import multiprocessing
import signal
import threading
import types
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, unwrap_vec_normalize

_CALLS = "_n_hooked_calls"
_MOVES = ("step", "reset")
_VEC_MOVES = ("step", "step_async", "reset", "env_method")


def copied(values: Any) -> Any:
    """Observations or infos that nobody else can change: arrays are copied, at any depth of dictionaries, lists and tuples."""
    if isinstance(values, np.ndarray):
        return values.copy()
    if isinstance(values, dict):
        made = copy.copy(values)  # of its own class, which wrappers may rely on
        made.update((name, copied(value)) for name, value in values.items())
        return made
    return type(values)(map(copied, values)) if type(values) in (tuple, list) else values


def _env_hook(name: str) -> Callable[..., Any]:
    def call(self: gym.Env[Any, Any], *args: Any, **kwargs: Any) -> Any:
        vars(self)[_CALLS] += 1
        return copied(getattr(type(self), name)(self, *args, **kwargs))

    call.__name__ = name  # a pickled environment looks its methods up by name
    return call


def _vec_env_hook(name: str) -> Callable[..., Any]:
    def call(self: VecEnv, *args: Any, **kwargs: Any) -> Any:
        method = args[0] if args else kwargs.get("method_name")
        if name != "env_method" or method in _MOVES:
            vars(self)[_CALLS] += 1
        return getattr(type(self), name)(self, *args, **kwargs)

    call.__name__ = name
    return call


_ENV_HOOKS = {name: _env_hook(name) for name in _MOVES}
_VEC_ENV_HOOKS = {name: _vec_env_hook(name) for name in _VEC_MOVES}


def _install(target: Any, hooks: dict[str, Callable[..., Any]]) -> None:
    """Bound methods among the target's attributes, which a copy of the target gets as its own; again does nothing."""
    own = vars(target)
    own.setdefault(_CALLS, 0)
    for name, hook in hooks.items():
        own.setdefault(name, types.MethodType(hook, target))
    # checkpoints keep the state of environments, which these are not
    own["checkpoint_skipped"] = {*getattr(target, "checkpoint_skipped", ()), _CALLS, "checkpoint_skipped", *hooks}


def hook_env(env: gym.Env[Any, Any]) -> None:
    """Count every ``step`` and ``reset`` of the environment itself, and copy what it and its outermost wrapper return."""
    for layer in (env.unwrapped, env):
        _install(layer, _ENV_HOOKS)


class _HooksWhatItIsAskedOf(type):
    def __instancecheck__(cls, instance: Any) -> bool:
        hook_env(instance)
        return True


class _Hooked(metaclass=_HooksWhatItIsAskedOf):
    """``VecEnv.env_is_wrapped(_Hooked)`` hooks the environments, also those in other processes, and is true where it did."""


def _on_arrival() -> type:
    """In another process: Ctrl-C in a terminal reaches every process. The one that learns decides what it means."""
    if multiprocessing.parent_process() is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return _Hooked


def _pickled(hooked: _HooksWhatItIsAskedOf) -> Any:
    return _on_arrival, ()


copyreg.pickle(_HooksWhatItIsAskedOf, _pickled)


def hook_vec_env(venv: VecEnv) -> VecEnv:
    """Hook the environments of a vectorized one: what is below its wrappers."""
    venv = venv.unwrapped
    if isinstance(venv, DummyVecEnv):
        for env in venv.envs:
            hook_env(env)
        return venv
    _install(venv, _VEC_ENV_HOOKS)
    with suppress(AttributeError, NotImplementedError, TypeError):  # in another process without any wrapper
        venv.env_is_wrapped(_Hooked)  # type: ignore[arg-type]
    return venv


class WatchedVecEnv(VecEnvWrapper):
    """
    The training environment as one algorithm steps it: what arrives is copied, and other callers are noticed.

    Many environments reuse one array for their observations. Evaluation in the training environment moves it to another
    state. Neither is visible in what SB3's ``step`` returns. The hooks do not depend on wrappers such as Monitor. Steps of a
    single environment that were made directly are noticed where it runs in this process.

    :param venv: the training environment
    """

    def __init__(self, venv: VecEnv) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # SB3 has warned about it when the environment was made
            super().__init__(venv)
        self._normalize = unwrap_vec_normalize(venv)
        base = hook_vec_env(venv)
        self._counted: list[Any] = [env.unwrapped for env in base.envs] if isinstance(base, DummyVecEnv) else [base]
        self.mark()

    @property
    def n_calls(self) -> int:
        """Calls of ``step`` and ``reset`` so far."""
        return sum(vars(one)[_CALLS] for one in self._counted)

    @property
    def is_disturbed(self) -> bool:
        """Whether the environment was stepped or reset by another caller since :meth:`mark`."""
        return self.n_calls != self._n_calls

    def mark(self) -> None:
        """The environment is now where the algorithm left it."""
        self._n_calls = self.n_calls
        if self._normalize is not None:
            self._original = {name: copied(vars(self._normalize).get(name)) for name in ("old_obs", "old_reward")}
            self.put_back()

    def put_back(self) -> None:
        """After other calls: what VecNormalize keeps unnormalized is again that of the last own step."""
        if self._normalize is not None:
            vars(self._normalize).update({name: value for name, value in self._original.items() if value is not None})

    def reset(self) -> Any:
        """As the environment's."""
        observations = copied(self.venv.reset())
        self.mark()
        return observations

    def step_wait(self) -> Any:
        """As the environment's; the observations are copies."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = copied(info["terminal_observation"])
        self.mark()
        return copied(observations), rewards, dones, infos
