"""Constructors that add keywords to those of another class, without a list of all of them in every class."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TypeVar

Class = TypeVar("Class", bound=type)


def with_keywords_of(base: type) -> Callable[[Class], Class]:
    """
    Give a class whose ``__init__`` passes ``**options`` on to ``base`` the signature that it really has, so that ``help``, the
    settings files and the checkpoints know every keyword.

    :param base: where ``**options`` goes
    :return: a decorator of the class
    """

    def decorate(kind: Class) -> Class:
        own = inspect.signature(kind.__init__).parameters  # type: ignore[misc]
        named = {name: part for name, part in own.items() if part.kind is not inspect.Parameter.VAR_KEYWORD}
        inherited = inspect.signature(base.__init__).parameters  # type: ignore[misc]
        for name, parameter in inherited.items():
            if parameter.kind not in (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL):
                named.setdefault(name, parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
        ordered = sorted(named.values(), key=lambda parameter: parameter.kind)
        kind.__init__.__signature__ = inspect.Signature(ordered)  # type: ignore[misc]
        return kind

    return decorate
