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
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper, unwrap_vec_normalize

from sb3_actpc.utils.nested import map_observations
from sb3_actpc.utils.precision import warn_of_indistinguishable

_CALLS = "_n_hooked_calls"
_LATEST = "_latest_observation"  # in the environment's own precision
_ENDS = "_last_observations"  # of the episodes that ended in the last step, by their environments' numbers
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
    if isinstance(values, tuple) and hasattr(values, "_fields"):
        return type(values)(*map(copied, values))
    if type(values) in (tuple, list):
        return type(values)(map(copied, values))
    if isinstance(values, dict):
        container = copy.copy(values)
        container.update({name: copied(value) for name, value in values.items()})
        return container
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


def _keep_ends(self: VecEnv) -> Any:
    returned = type(self).step_wait(self)
    key = "terminal_observation"
    vars(self)[_ENDS] = {env: copied(info[key]) for env, info in enumerate(returned[3]) if info.get(key) is not None}
    return returned


_keep_ends.__name__ = "step_wait"
_ENV_HOOKS = {name: _env_hook(name) for name in _MOVES}
_VEC_ENV_HOOKS = {name: _vec_env_hook(name) for name in _VEC_MOVES}

_END_HOOKS = {"step_wait": _keep_ends}


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


def _on_arrival() -> type:
    """In another process: Ctrl-C in a terminal reaches every process. The one that learns decides what it means."""
    if multiprocessing.parent_process() is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return _Hooked


def _pickled(hooked: _HooksWhatItIsAskedOf) -> Any:
    return _on_arrival, ()


copyreg.pickle(_HooksWhatItIsAskedOf, _pickled)


def hook_vec_env(venv: VecEnv) -> tuple[VecEnv, bool]:
    """Hook the environments of a vectorized one: what is below its wrappers, and whether that was possible."""
    while isinstance(venv, VecEnvWrapper):
        venv = venv.venv
    if isinstance(venv, DummyVecEnv):
        for env in venv.envs:
            hook_env(env)
        return venv, True
    _install(venv, _VEC_ENV_HOOKS)
    with suppress(AttributeError, NotImplementedError, TypeError):
        return venv, all(venv.env_is_wrapped(_Hooked))  # type: ignore[arg-type]
    return venv, False  # in another process without any wrapper


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
        self._infos: list[dict[str, Any]] = []
        self._ends: dict[int, Any] = {}
        if self._normalize is not None:
            _install(self._normalize.venv, _END_HOOKS)
        self._outside = [] if self._normalize is None else _outside(venv, self._normalize)
        if self._outside and self._normalize is not None and self._normalize.observation_space != venv.observation_space:
            raise self._wrong_order("observations")
        self._base, self._copies = hook_vec_env(venv)
        self._seen: list[Any] | None = []  # until their precision is checked
        self._counted: list[Any] = [self._base]
        if isinstance(self._base, DummyVecEnv):
            self._counted = [_innermost(env) for env in self._base.envs]
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
        """After other calls: what VecNormalize keeps unnormalized is again that of the last own step."""
        if self.is_disturbed:
            self._put_back_original()
            self._normalize_ends()

    def _put_back_original(self) -> None:
        if self._normalize is not None:
            vars(self._normalize).update({name: value for name, value in self._original.items() if value is not None})

    def finish_step(self) -> None:
        """Ctrl-C may come between a step in other processes and its result, which the next call would take for its own."""
        base = self._base
        if not isinstance(base, SubprocVecEnv) or not base.waiting:
            return
        for remote in base.remotes:
            remote.send(("has_attr", "step"))
        for remote in base.remotes:
            while not isinstance(remote.recv(), bool):  # the results of a step are a tuple
                pass
        base.waiting = False

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
        self._infos = infos
        self._ends = {} if self._normalize is None else vars(self._normalize.venv)[_ENDS]
        self._normalize_ends()
        self.mark()
        self._check_order(observations, rewards)
        self._check_precision(observations)
        return observations, rewards, dones, infos

    def _normalize_ends(self) -> None:
        """An episode's last observation is stored as it was: VecNormalize clips it, and what is clipped cannot be undone."""
        for env, observation in self._ends.items():
            self._infos[env]["terminal_observation"] = _unclipped(self._normalize, observation)

    def _check_order(self, observations: Any, rewards: np.ndarray) -> None:
        """Once: what arrives here is what VecNormalize returned."""
        if not self._outside or self._normalize is None:
            return
        normalized: Any = self._normalize.normalize_obs(self._normalize.get_original_obs())
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


def _unclipped(normalize: Any, observation: Any) -> Any:
    """What ``unnormalize_obs`` turns into the observation, however far it lies from the mean."""
    if not normalize.norm_obs:
        return observation
    if not isinstance(observation, dict):
        return (observation - normalize.obs_rms.mean) / np.sqrt(normalize.obs_rms.var + normalize.epsilon)
    normalized = dict(observation)
    for key in normalize.norm_obs_keys:
        statistics = normalize.obs_rms[key]
        normalized[key] = (observation[key] - statistics.mean) / np.sqrt(statistics.var + normalize.epsilon)
    return normalized


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
