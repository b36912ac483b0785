"""Versions of packages, for what is kept of a run."""

from importlib.metadata import PackageNotFoundError, version


def installed_version(package: str) -> str:
    """Of a distribution; ``"unknown"`` for a source checkout, or an extra, that is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
