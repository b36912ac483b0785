"""Packages that may not be installed, and the versions of those that are."""

import importlib
import sys
from importlib.metadata import PackageNotFoundError, version
from typing import Any

NUMPY_1_PYTHON = (3, 12)  # the newest with wheels of NumPy 1, which robosuite needs


def import_extra(module: str, extra: str) -> Any:
    """Import a module that an extra of this package installs; ImportError, which says how to install it, when it or something
    that it needs is not there."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        more = ""
        if module == "robosuite" and sys.version_info[:2] > NUMPY_1_PYTHON:  # where the extra leaves it out
            more = f" from Python 3.{NUMPY_1_PYTHON[1]} or older, which has wheels of the NumPy 1 that robosuite needs"
        if module == "d3rlpy":  # the extra holds what it needs
            more = ", then pip install --no-deps d3rlpy==2.8.1, which asks for an older Gymnasium that it does not need"
        raise ImportError(f'{error}: install what is needed with pip install "sb3-actpc[{extra}]"{more}') from error


def installed_version(package: str) -> str:
    """Of a distribution; ``"unknown"`` for a source checkout, or an extra, that is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
