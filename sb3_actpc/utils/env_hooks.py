"""Hooks in a training environment: calls are counted, and what an environment returns is a copy."""

import types
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, unwrap_vec_normalize

from sb3_actpc.utils.nested import map_observations
from sb3_actpc.utils.precision import warn_of_indistinguishable

_CALLS = "_n_hooked_calls"
_LATEST = "_latest_observation"  # in the environment's own precision
_BEFORE = "_unhooked_"  # before the name of a method that was an attribute of the environment already
_MOVES = ("step", "reset")
N_CHECKED = 100  # observations whose precision is compared with float32
_VEC_MOVES = ("step", "step_async", "reset", "env_method")


def copied(values: Any) -> Any:
    """Observations or infos that nobody else can change: arrays and tensors are copied, at any depth of the containers."""
    if isinstance(values, np.ndarray):
        return values.copy()
    if isinstance(values, th.Tensor):
        return values.clone()
    if type(values) in (tuple, list):
        return type(values)(map(copied, values))
    if type(values) is dict:
        return {name: copied(value) for name, value in values.items()}
    return values


def _env_hook(name: str) -> Callable[..., Any]:
    def call(self: gym.Env[Any, Any], *args: Any, **kwargs: Any) -> Any:
        own = vars(self)
        own[_CALLS] += 1
        before = own.get(_BEFORE + name)
        returned = getattr(type(self), name)(self, *args, **kwargs) if before is None else before(*args, **kwargs)
        returned = copied(returned)
        own[_LATEST] = returned[0]
        return returned

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
        present = own.get(name)
        if getattr(present, "__func__", None) is hook:
            continue
        if present is not None:
            own[_BEFORE + name] = present
        own[name] = types.MethodType(hook, target)


def _innermost(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    while isinstance(env, gym.Wrapper):
        env = env.env
    return env


def hook_env(env: gym.Env[Any, Any]) -> None:
    """Count every ``step`` and ``reset`` of the environment itself, and copy what it and its outermost wrapper return."""
    for layer in (_innermost(env), env):
        _install(layer, _ENV_HOOKS)
        # checkpoints keep the state of environments, which these are not
        names = {_CALLS, _LATEST, "checkpoint_skipped", *(prefix + name for name in _MOVES for prefix in ("", _BEFORE))}
        vars(layer)["checkpoint_skipped"] = {*getattr(layer, "checkpoint_skipped", ()), *names}


class _HooksWhatItIsAskedOf(type):
    def __instancecheck__(cls, instance: Any) -> bool:
        hook_env(instance)
        return True


class _Hooked(metaclass=_HooksWhatItIsAskedOf):
    """``VecEnv.env_is_wrapped(_Hooked)`` hooks the environments, also those in other processes, and is true where it did."""


class WatchedVecEnv(VecEnvWrapper):
    """
    The training environment as one algorithm steps it: what arrives is copied, and other callers are noticed.

    Many environments reuse one array for their observations. Evaluation in the training environment moves it to another
    state. Neither is visible in what SB3's ``step`` returns. The hooks do not depend on wrappers such as Monitor. Steps of a
    single environment that were made directly are noticed where it runs in this process.

    :param venv: the training environment
    :raises ValueError: where a wrapper outside VecNormalize changes what it returns: SB3 stores what arrives at VecNormalize
    """

    def __init__(self, venv: VecEnv) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # SB3 has warned about it when the environment was made
            super().__init__(venv)
        self._normalize = unwrap_vec_normalize(venv)
        base = venv
        while isinstance(base, VecEnvWrapper):
            base = base.venv
        self._outside = [] if self._normalize is None else _outside(venv, self._normalize)
        if self._outside and self._normalize is not None and self._normalize.observation_space != venv.observation_space:
            raise self._wrong_order("observations")
        self._copies = True
        self._base = base
        self._seen: list[Any] | None = []  # until their precision is checked
        self._counted: list[Any] = [base]
        if isinstance(base, DummyVecEnv):
            for env in base.envs:
                hook_env(env)
            self._counted = [_innermost(env) for env in base.envs]
        else:
            _install(base, _VEC_ENV_HOOKS)
            self._copies = _hook_others(base)
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
            self._put_back_original()

    def put_back(self) -> None:
        """After other calls: VecNormalize's unnormalized observations and rewards are again those of the last own step."""
        if self.is_disturbed:
            self._put_back_original()

    def _put_back_original(self) -> None:
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
        observations = copied(observations)
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = copied(info["terminal_observation"])
        if not self._copies:
            self._check_last_observations(observations, dones, infos)
        self.mark()
        self._check_order(observations, rewards)
        self._check_precision(observations)
        return observations, rewards, dones, infos

    def _check_order(self, observations: Any, rewards: np.ndarray) -> None:
        """Once: what arrives here is what VecNormalize returned."""
        if not self._outside or self._normalize is None:
            return
        normalized = self._normalize.normalize_obs(self._normalize.get_original_obs())
        parts = [(observations, normalized)]
        if isinstance(observations, dict):
            parts = [(observations[key], normalized[key]) for key in observations]
        if not all(np.allclose(mine, theirs) for mine, theirs in parts):
            raise self._wrong_order("observations")
        if not np.allclose(rewards, self._normalize.normalize_reward(self._normalize.get_original_reward())):
            raise self._wrong_order("rewards")
        self._outside = []

    def _wrong_order(self, what: str) -> ValueError:
        inner = self._outside[-1]
        return ValueError(
            f"{' of '.join(self._outside)} of VecNormalize: a wrapper outside VecNormalize changes the {what}, and the replay "
            f"buffer holds those that VecNormalize was given. VecNormalize goes outside: VecNormalize({inner}(...))"
        )

    def _check_precision(self, observations: Any) -> None:
        """Name the features that float32 cannot follow, once, by the first observations of the first environment."""
        if self._seen is None:
            return
        arrived = observations if self._normalize is None else self._normalize.old_obs
        parts = arrived.values() if isinstance(arrived, dict) else [arrived]
        if self._normalize is not None and self._normalize.norm_obs and all(part.dtype == np.float64 for part in parts):
            self._seen = None  # an offset is subtracted before float32
            return
        rows = map_observations(lambda array: array[0], arrived)
        if isinstance(self._base, DummyVecEnv):  # which converts to the type of the space
            rows = vars(self._base.envs[0])[_LATEST]
        self._seen.append(rows)
        if len(self._seen) == N_CHECKED:
            warn_of_indistinguishable(_stacked(self._seen), "")
            self._seen = None

    def _check_last_observations(self, observations: Any, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """An environment that could not be hooked may have overwritten an episode's last observation in its reset."""
        for env in np.flatnonzero(dones):
            last = infos[env].get("terminal_observation")
            parts = [(observations, last)]
            if isinstance(observations, dict):
                parts = [(observations[key], (last or {}).get(key)) for key in observations]
            if all(theirs is not None and np.array_equal(mine[env], theirs) for mine, theirs in parts):
                warnings.warn(
                    "the last observation of an episode equals the first one of the next: an environment that returns one and "
                    "the same array must return a copy of it, or be wrapped in stable_baselines3's Monitor",
                    stacklevel=2,
                )
                self._copies = True  # said once


def _outside(venv: VecEnv, normalize: VecEnv) -> list[str]:
    """The wrappers outside VecNormalize, the outermost first."""
    names = []
    while isinstance(venv, VecEnvWrapper) and venv is not normalize:
        names.append(type(venv).__name__)
        venv = venv.venv
    return names


def _stacked(observations: list[Any]) -> Any:
    """Observations as rows, at any depth of dictionaries."""
    if isinstance(observations[0], dict):
        return {key: _stacked([one[key] for one in observations]) for key in observations[0]}
    return np.array(observations)


def _hook_others(base: VecEnv) -> bool:
    """Whether environments in other processes could be hooked: those without any wrapper cannot."""
    with suppress(AttributeError, NotImplementedError, TypeError):
        return all(base.env_is_wrapped(_Hooked))  # type: ignore[arg-type]
    return False
