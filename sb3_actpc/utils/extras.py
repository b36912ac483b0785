"""Packages that only a part of the users needs."""

import importlib
from typing import Any


def import_extra(module: str, extra: str) -> Any:
    """Import a module that an extra of this package installs; ImportError, which says how to install it, when it or something
    that it needs is not there."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f'{error}: install what is needed with pip install "sb3-actpc[{extra}]"') from error
