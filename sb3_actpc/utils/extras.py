"""Packages that only a part of the users needs."""

import importlib
from typing import Any


def import_extra(module: str, extra: str) -> Any:
    """Import a module of an extra.

    :param module: its name
    :param extra: of this package, which installs it
    :return: the module
    :raises ImportError: when it, or something that it needs, is not installed; the message says how to install it
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f'{error}: install what is needed with pip install "sb3-actpc[{extra}]"') from error
