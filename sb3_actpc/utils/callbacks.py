"""SB3's callbacks, and those that are called where SB3 calls none."""

from collections.abc import Callable
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList


def callback_tree(callback: Any) -> list[BaseCallback]:
    """A callback and all in it, lists left out, in the order in which they are called."""
    if isinstance(callback, CallbackList):
        return [one for child in callback.callbacks for one in callback_tree(child)]
    if not isinstance(callback, BaseCallback):
        return []
    children = [getattr(callback, name, None) for name in ("callback", "callback_on_new_best")]  # SB3's EvalCallback has both
    return [callback, *(one for child in children for one in callback_tree(child))]


def between_updates(callback: BaseCallback) -> Callable[[], None]:
    """For algorithms that learn before their first rollout, in ``_setup_learn``, where SB3 calls no callback.

    :param callback: what SB3's ``_setup_learn`` returns
    :return: to be called before each of those updates; calls ``on_pretraining_update(callback)`` of the callbacks that have it
    """
    hooks = [one.on_pretraining_update for one in callback_tree(callback) if hasattr(one, "on_pretraining_update")]

    def call_hooks() -> None:
        for hook in hooks:
            hook(callback)

    return call_hooks
