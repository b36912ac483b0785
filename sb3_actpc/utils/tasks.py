"""Which task a vectorised environment is of, and whether an episode succeeded."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

# as Gymnasium writes an environment: <TimeLimit<OrderEnforcing<HopperEnv<Hopper-v5>>>>
_WRITTEN_ID = re.compile(r"<([^<>\s]+)>+$")


def written_as(env: VecEnv) -> str | None:
    """How Gymnasium writes the first environment with its wrappers; None where the environment cannot be asked, as not every
    kind of vectorised environment can."""
    try:
        return str(env.env_method("__str__", indices=0)[0])
    except (AttributeError, NotImplementedError):
        return None


def task_id(env: VecEnv) -> str | None:
    """The Gymnasium id of its first environment; None where it has none. One in another process is asked for what it is
    written as: a spec holds the keywords that the environment was made with, and not all of these can be sent (a function
    without a name, say)."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    if isinstance(env.unwrapped, DummyVecEnv):
        spec = getattr(env.unwrapped.envs[0].unwrapped, "spec", None)
        return spec.id if spec is not None else None
    found = _WRITTEN_ID.search(written_as(env) or "")
    return found.group(1) if found else None


def success_of(info: Mapping[str, Any]) -> float | None:
    """1 or 0, of SB3's ``is_success`` or, as in Gymnasium-Robotics' Adroit tasks and Meta-World, ``success``; None without.
    ValueError for what is no number."""
    success = info.get("is_success", info.get("success"))
    try:
        return None if success is None else float(success)
    except (TypeError, ValueError):
        raise ValueError(f"info['is_success'] (or 'success') must be true or false, found {success!r}") from None
