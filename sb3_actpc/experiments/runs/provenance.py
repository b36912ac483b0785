"""Where the numbers of a run come from: versions of the packages, and the commit of a source checkout."""

import platform
import subprocess
from pathlib import Path

from sb3_actpc.utils.extras import installed_version

_PACKAGES = ("sb3-actpc", "stable-baselines3", "torch", "gymnasium", "mujoco", "robosuite", "numpy")
CHECKOUT = Path(__file__).resolve().parents[3]


def package_versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on; ``"unknown"`` for one that is not installed."""
    return {"python": platform.python_version(), **{name: installed_version(name) for name in _PACKAGES}}


def git_state(checkout: Path = CHECKOUT) -> tuple[str | None, bool | None]:
    """The commit of a source checkout, 40 hex digits, and whether files that git knows differ from it; None and None for an
    installed package or where git cannot be asked."""
    if not (checkout / ".git").exists():
        return None, None
    try:
        commit = _git(checkout, "rev-parse", "HEAD")
        changes = _git(checkout, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None, None
    return commit, bool(changes)


def _git(checkout: Path, *arguments: str) -> str:
    command = ["git", "-C", str(checkout), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
