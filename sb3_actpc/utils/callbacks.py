"""SB3's callbacks."""

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
