"""Observations of one part, an array or a tensor, and of several, a dictionary of them."""

from collections.abc import Callable
from typing import Any


def map_observations(function: Callable[[Any], Any], observations: Any) -> Any:
    """Apply a function to an array or a tensor, or to every one in a dictionary of them: the results, in the same form."""
    if isinstance(observations, dict):
        return {key: function(value) for key, value in observations.items()}
    return function(observations)
