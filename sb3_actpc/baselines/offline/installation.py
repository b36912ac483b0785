"""Virtual environments of packages that pin other versions than this one does: ``sb3-actpc baselines install NAME``."""

import json
import os
import shutil
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sb3_actpc.utils.extras import NUMPY_1_PYTHON

FOLDER_VARIABLE = "SB3_ACTPC_BASELINES"
ABANDONED_AFTER = 24 * 3600  # seconds
COMPLETE = "sb3_actpc_complete.json"  # written last, into an environment that is whole


@dataclass(frozen=True)
class Recipe:
    """Arguments of ``pip install``, one call after the other, and a statement that must run in the finished environment."""

    steps: tuple[tuple[str, ...], ...]
    check: str


# torch comes first and by number, so that no CUDA libraries come with it where an index of CPU wheels is set
_TORCH = ("torch==2.13.0", "numpy==1.26.4")
RECIPES = {
    "d3rlpy": Recipe((_TORCH, ("d3rlpy==2.8.1",)), "import d3rlpy"),
}


def environments_folder() -> Path:
    """Where the environments are: ``$SB3_ACTPC_BASELINES``, or ``~/.cache/sb3_actpc/baselines``."""
    given = os.environ.get(FOLDER_VARIABLE)
    return Path(given).absolute() if given else Path.home() / ".cache" / "sb3_actpc" / "baselines"


def environment_python(name: str, folder: Path | None = None) -> Path:
    """The interpreter of the whole environment of a package; ImportError, which says how to make it, when there is none."""
    place = (environments_folder() if folder is None else folder) / name
    if not _is_complete(name, place):
        raise ImportError(f"{name} is not installed in {place}: run sb3-actpc baselines install {name}")
    return _python(place)


def install(name: str, folder: Path | None = None, report: Callable[[str], None] = lambda line: None) -> Path:
    """Make the environment of a package; one that is there and whole stays as it is, any other is made anew, under another
    name, and renamed when everything in it runs, so that a stopped command leaves no half of one. Its folder; ValueError when
    there is no such name, OSError, with the last thing that it said, when a step fails (no network, a full disk)."""
    if name not in RECIPES:
        raise ValueError(f"no recipe for {name!r}: choose one of {', '.join(sorted(RECIPES))}")
    folder = environments_folder() if folder is None else folder.absolute()
    place = folder / name
    if _is_complete(name, place):
        report(f"{name} is already installed in {place}")
        return place
    if sys.version_info[:2] > NUMPY_1_PYTHON:  # pip would compile it
        raise ValueError(
            f"{name} needs NumPy 1, which has no wheels for Python {sys.version_info[0]}.{sys.version_info[1]}: install it "
            f"from Python 3.10 to 3.{NUMPY_1_PYTHON[1]}, {place} then serves any other too"
        )
    folder.mkdir(parents=True, exist_ok=True)
    for left in folder.glob(f".{name}.*.tmp"):  # of a command that was killed, not of one that is at work
        if time.time() - left.stat().st_mtime > ABANDONED_AFTER:
            shutil.rmtree(left, ignore_errors=True)
    made = folder / f".{name}.{uuid.uuid4().hex[:8]}.tmp"
    try:
        _make(RECIPES[name], made, report)
        (made / COMPLETE).write_text(_signature(name), encoding="utf-8")
        shutil.rmtree(place, ignore_errors=True)  # another version, or without its last file
        os.replace(made, place)
    finally:
        shutil.rmtree(made, ignore_errors=True)
    report(f"{name} is installed in {place}")
    return place


def _make(recipe: Recipe, place: Path, report: Callable[[str], None]) -> None:
    report(f"making a virtual environment with {sys.executable}")
    _run([sys.executable, "-m", "venv", str(place)], "making a virtual environment")
    for step in recipe.steps:
        what = " ".join(part for part in step if not part.startswith("-"))
        report(f"pip install {what}")
        _run([str(_python(place)), "-m", "pip", "install", "--disable-pip-version-check", *step], f"pip install {what}")
    _run([str(_python(place)), "-c", recipe.check], recipe.check)


def _run(command: Sequence[str], what: str) -> None:
    """:raises OSError: when it fails, with what it said last"""
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False, stdin=subprocess.DEVNULL)
    if done.returncode:
        said = [line for line in f"{done.stdout}\n{done.stderr}".splitlines() if line.strip()]
        errors = [line for line in said if line.lstrip().upper().startswith("ERROR")]
        raise OSError(f"{what} failed: {(errors or said or [f'exit code {done.returncode}'])[-1].strip()}")


def _python(place: Path) -> Path:
    return place / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def _signature(name: str) -> str:
    return json.dumps({"steps": RECIPES[name].steps})


def _is_complete(name: str, place: Path) -> bool:
    """Whether it was made to its end, by the present recipe, and its interpreter is still there."""
    try:
        return (place / COMPLETE).read_text(encoding="utf-8") == _signature(name) and _python(place).exists()
    except (OSError, UnicodeDecodeError):
        return False
