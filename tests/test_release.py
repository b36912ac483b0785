"""What is installed: the import is quick and silent, and the wheel works without the source tree.

``python -m pytest -m slow tests/test_release.py`` runs the wheel in an empty environment.
"""

import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TRAIN = "train --env SparseReacher-v5 --steps 40 --eval-episodes 1 --checkpoint-freq 0 --no-progress"
TIMED = "import time; start = time.perf_counter(); import {}; print(time.perf_counter() - start)"


def seconds_to_import(module: str) -> float:
    """Shortest of three, each in an interpreter of its own."""
    command = [sys.executable, "-c", TIMED.format(module)]
    return min(float(subprocess.run(command, capture_output=True, text=True, check=True).stdout) for _ in range(3))


def test_the_import_takes_no_longer_than_that_of_stable_baselines3() -> None:
    assert seconds_to_import("sb3_actpc") <= 1.2 * seconds_to_import("stable_baselines3")


def test_the_import_is_silent() -> None:
    code = "import sb3_actpc; sb3_actpc.ActPC"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout + result.stderr == ""


def call(*command: str | Path, folder: Path) -> str:
    """The output of a command outside the source tree; AssertionError with its messages when it fails."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    result = subprocess.run([*map(str, command)], cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    call(sys.executable, "-m", "pip", "wheel", "--no-deps", "--wheel-dir", folder, ROOT, folder=folder)
    [path] = folder.glob("*.whl")
    return path


@pytest.mark.slow
def test_the_wheel_has_everything_that_is_no_code(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as file:
        packed = set(file.namelist())
    others = [path for path in (ROOT / "sb3_actpc").rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")]
    names = [str(path.relative_to(ROOT)) for path in others]
    names += [f"sb3_actpc/hyperparams/{path.name}" for path in (ROOT / "hyperparams").glob("*.yml")]
    assert {"sb3_actpc/py.typed", "sb3_actpc/agents/index.json"} <= set(names)
    assert sorted(set(names) - packed) == []


@pytest.mark.slow
def test_the_wheel_trains_and_plays_in_an_empty_environment(wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "venv", with_pip=True)
    bin_folder = tmp_path / "venv" / ("Scripts" if sys.platform == "win32" else "bin")
    # by version: where a wheel without CUDA lies at hand, it is taken
    call(bin_folder / "python", "-m", "pip", "install", "torch==2.13.0", folder=tmp_path)
    call(bin_folder / "python", "-m", "pip", "install", f"{wheel}[experiments]", folder=tmp_path)
    code = "import sb3_actpc; print(sb3_actpc.__file__)"
    assert str(tmp_path) in call(bin_folder / "python", "-c", code, folder=tmp_path)
    call(bin_folder / "sb3-actpc", *TRAIN.split(), "--output", "run", folder=tmp_path)
    assert (tmp_path / "run" / "result.json").is_file()
    options = ("--env", "SparseReacher-v5", "--episodes", "1", "--video", "reacher.gif")
    assert "episode 0: return" in call(bin_folder / "sb3-actpc", "enjoy", *options, folder=tmp_path)
