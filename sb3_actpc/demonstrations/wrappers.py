"""Wrappers between a task's Gymnasium id and the agent, or the recording: which of them change units."""

from __future__ import annotations

import copy
import re
import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from numbers import Number
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from sb3_actpc.demonstrations.rows import flatten_observation

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

# wrappers that pass observations, actions and rewards on as they are
PLAIN = {"Monitor", "TimeLimit", "OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics", "Autoreset"}
PLAIN |= {"RecordVideo", "RenderCollection", "HumanRendering"}
PLAIN |= {"PatchedTimeLimit"}  # rl-zoo3 replaces Gymnasium's TimeLimit by it on import
# vectorised wrappers of Stable-Baselines3, which the agent undoes or which change the shape
PLAIN_VECTORISED = ("stable_baselines3.", "sb3_contrib.", "sb3_actpc.")
N_STEPS = 10  # of the comparison; at each the task's reward is replaced by another known one
REWARDS = (1.0, 0.0, -2.0, 0.5)
_START = "OrderEnforcing"  # the innermost wrapper of gymnasium.make: what is inside belongs to the id


@dataclass(frozen=True)
class Wrapping:
    """The wrappers around a task that change its observations, actions or rewards."""

    names: tuple[str, ...] = ()  # the outermost first, with their numbers: RescaleAction(max_action=2.0, min_action=-2.0)
    # "observations" (which other actions change too) and "rewards"; empty when nothing could be compared
    effects: tuple[str, ...] = ()


def wrapping_of(env: gym.Env[Any, Any], actions: np.ndarray) -> Wrapping:
    """The wrappers of an environment that change something.

    They are copied around a new environment of the same id, which plays the actions (N, action_dim); another one without them
    does the same. The environment itself is not touched. Wrappers that cannot be compared count as changing something.
    """
    wrappers = _outer_wrappers(env)
    if all(type(wrapper).__name__ in PLAIN for wrapper in wrappers):
        return Wrapping()
    names = tuple(_describe(wrapper) for wrapper in wrappers if type(wrapper).__name__ not in PLAIN)
    try:
        effects = _effects(env, wrappers, actions)
    except Exception:  # of any environment and any wrapper
        return Wrapping(names)
    return Wrapping(names, effects) if effects else Wrapping()


def wrapping_of_vectorised(env: VecEnv, actions: np.ndarray) -> Wrapping:
    """As :func:`wrapping_of`, for the first environment of a vectorised one. Of one in another process, and of vectorised
    wrappers, only the names are known."""
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper  # heavy: demonstrations do without

    outer = []
    while isinstance(env, VecEnvWrapper):
        if not type(env).__module__.startswith(PLAIN_VECTORISED):
            outer.append(type(env).__name__)
        env = env.venv
    if isinstance(env, DummyVecEnv):
        inner = wrapping_of(env.envs[0], actions)
    else:
        inner = Wrapping(_written_names(env))
    return Wrapping((*outer, *inner.names), () if outer else inner.effects)


def check_wrapping(found: Wrapping, recorded: Sequence[str] | None, env_id: str) -> None:
    """Compare the agent's wrappers with those that the demonstrations were recorded behind, None where that is not known.
    ValueError when the agent's environment shows or takes other numbers than the recorded one. Warns when it may, and when
    only the rewards differ."""
    known = tuple(recorded or ())
    has_same_names = [_class_name(name) for name in found.names] == [_class_name(name) for name in known]
    if found.names == known or (has_same_names and not found.effects):
        return
    ours = ", ".join(found.names) or "no wrapper"
    if found.effects:
        ours += f" (changes {' and '.join(found.effects)})"
    theirs = "wrappers that are not known" if recorded is None else ", ".join(known) or "no wrapper"
    message = (
        f"demonstrations of {env_id} were recorded behind {theirs}, the agent learns behind {ours}: record them in the "
        "agent's environment (Demonstrations.record). If they are in its units, say so: dataclasses.replace(demonstrations, "
        f'metadata={{**demonstrations.metadata, "wrappers": {list(found.names)}}})'
    )
    if recorded is not None and "observations" in found.effects:
        raise ValueError(message)
    warnings.warn(message, stacklevel=3)


def _outer_wrappers(env: gym.Env[Any, Any]) -> list[gym.Wrapper[Any, Any, Any, Any]]:
    """The wrappers outside of what an id stands for, the outermost first; all of them where that is not known."""
    wrappers: list[gym.Wrapper[Any, Any, Any, Any]] = []
    while isinstance(env, gym.Wrapper) and type(env).__name__ != _START:
        wrappers.append(env)
        env = env.env
    spec = gym.registry.get(env.spec.id) if env.spec is not None else None
    registered = {wrapper.name for wrapper in spec.additional_wrappers} if spec is not None else set()
    return [wrapper for wrapper in wrappers if type(wrapper).__name__ not in registered]


def _effects(
    env: gym.Env[Any, Any], wrappers: Sequence[gym.Wrapper[Any, Any, Any, Any]], actions: np.ndarray
) -> tuple[str, ...]:
    spec = copy.copy(env.unwrapped.spec)
    if spec is None:
        raise ValueError("an environment without an id cannot be made again")
    spec.additional_wrappers = ()
    spec.disable_env_checker = True
    spec.kwargs = {name: value for name, value in spec.kwargs.items() if name != "render_mode"}
    with ExitStack() as stack:
        first, second, inner = (_KnownRewards(stack.enter_context(closing(gym.make(spec)))) for _ in range(3))
        copies: dict[int, Any] = {id(env.unwrapped): inner.unwrapped}
        wrapped: gym.Env[Any, Any] = inner
        for wrapper in reversed(wrappers):
            if type(wrapper).__name__ in PLAIN:
                copies[id(wrapper)] = wrapped
                continue
            copies[id(wrapper.env)] = wrapped
            wrapped = copies[id(wrapper)] = copy.deepcopy(wrapper, copies)
        plain, again, changed = (_play(one, actions) for one in (first, second, wrapped))
    if not all(_same(*pair) for pair in zip(plain, again, strict=True)):
        raise ValueError("the task itself is not the same with the same seed")
    return tuple(name for name, *pair in zip(("observations", "rewards"), plain, changed, strict=True) if not _same(*pair))


class _KnownRewards(gym.Wrapper[Any, Any, Any, Any]):
    """Replaces the task's rewards, most of which are 0 in a sparse one."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, _, terminated, truncated, info = self.env.step(action)
        self.n_steps = getattr(self, "n_steps", 0) + 1
        return observation, REWARDS[self.n_steps % len(REWARDS)], terminated, truncated, info


def _play(env: gym.Env[Any, Any], actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The observations (n + 1, obs_dim) and rewards (n,) of the first actions."""
    rows = [flatten_observation(env.observation_space, env.reset(seed=0)[0])]
    rewards = []
    for action in actions[:N_STEPS]:
        observation, reward, terminated, truncated, _ = env.step(
            np.asarray(action, env.action_space.dtype).reshape(env.action_space.shape or ())
        )
        rows.append(flatten_observation(env.observation_space, observation))
        rewards.append(float(reward))
        if terminated or truncated:
            break
    return np.stack(rows), np.array(rewards)


def _same(first: np.ndarray, second: np.ndarray) -> bool:
    return first.shape == second.shape and np.allclose(first, second, rtol=1e-5, atol=1e-6, equal_nan=True)


def _describe(wrapper: gym.Wrapper[Any, Any, Any, Any]) -> str:
    """A wrapper's class and the numbers that it was made with: ``RescaleAction(max_action=2.0, min_action=-2.0)``."""
    given: Mapping[str, Any] = getattr(wrapper, "_saved_kwargs", {})
    numbers = {key: value for key, value in given.items() if isinstance(value, Number | np.ndarray)}
    shown = ", ".join(f"{key}={np.asarray(value).tolist()}" for key, value in sorted(numbers.items()))
    return f"{type(wrapper).__name__}({shown})" if shown else type(wrapper).__name__


def _class_name(name: str) -> str:
    return name.partition("(")[0]


def _written_names(env: VecEnv) -> tuple[str, ...]:
    """The wrappers of an environment in another process, from what it is written as: ``<Monitor<TimeLimit<...>>>``."""
    try:
        written = str(env.env_method("__str__", indices=0)[0])
    except (AttributeError, NotImplementedError):  # not every kind of vectorised environment can be asked
        return ()
    outside, start, _ = written.partition(f"<{_START}")
    names = re.findall(r"<(\w+)(?=<)", outside)
    if not start and not written.rstrip(">").endswith(" instance"):
        names = names[:-1]  # the environment itself, which has an id
    return tuple(name for name in names if name not in PLAIN)
