"""
Planted faults: every patch in ``tests/mutants`` breaks one line, and the test that its first line names must fail.

Run by its own command: ``python tests/mutants.py``, or with parts of names to run some of them. It works on a copy.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def run_tests(folder: Path, test: str) -> int:
    """pytest's exit status for one test of a copy: 0 passed, 1 failed, others for what could not run."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-W", "ignore", "-p", "no:cacheprovider", test]
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=False).returncode


def outcome(folder: Path, patch: Path) -> str:
    """ "killed", "SURVIVED", or why the mutant says nothing."""
    test = patch.read_text(encoding="utf-8").partition("\n")[0].removeprefix("Killed by ")
    apply = ["git", "apply", "--recount", "-C1", str(patch)]
    if subprocess.run(apply, cwd=folder, capture_output=True, check=False).returncode:
        return "DOES NOT APPLY: write the patch anew"
    status = run_tests(folder, test)
    subprocess.run([*apply[:2], "--reverse", *apply[2:]], cwd=folder, check=True)
    return {0: f"SURVIVED {test}", 1: "killed"}.get(status, f"NO SUCH TEST {test}")


def main(wanted: list[str]) -> int:
    """1 where a mutant is not killed."""
    patches = sorted((ROOT / "tests" / "mutants").glob("*.patch"))
    chosen = [one for one in patches if not wanted or any(part in one.stem for part in wanted)]
    n_killed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("sb3_actpc", "tests", "docs"):
            shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", folder)
        for patch in chosen:
            result = outcome(folder, patch)
            n_killed += result == "killed"
            print(f"{patch.stem:40} {result}", flush=True)
    print(f"{n_killed} of {len(chosen)} killed")
    return int(n_killed < len(chosen))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
