"""
Planted faults: every patch in ``tests/mutants`` breaks one line, and the test that its first line names must fail.

Run by its own command: ``python tests/mutants.py``, or with parts of names to run some of them. It works on a copy.
"""

import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
REPORTED = 100  # added to pytest's exit status, so that a crash is told from a failed test


def run_in(folder: str, tests: list[str]) -> None:
    """Ends this process with ``REPORTED`` plus pytest's exit status for tests of a copy."""
    os.chdir(folder)
    sys.path.insert(0, folder)
    sys.dont_write_bytecode = True
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    sys.exit(REPORTED + pytest.main(["-q", "-x", "-W", "ignore", "-p", "no:cacheprovider", *tests]))


def run_tests(folder: Path, tests: list[str]) -> str:
    """ "passed", "failed" or "did not run"; a process that crashes says nothing. Large packages are imported once for all."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["pytest", "torch", "stable_baselines3", "mujoco"])
    process = context.Process(target=run_in, args=(str(folder), tests))
    process.start()
    process.join()
    return {REPORTED: "passed", REPORTED + 1: "failed"}.get(process.exitcode or 0, "did not run")


def test_of(patch: Path) -> str:
    """The test that must fail."""
    return patch.read_text(encoding="utf-8").partition("\n")[0].removeprefix("Killed by ")


def outcome(folder: Path, patch: Path) -> str:
    """ "killed", "SURVIVED", or why the mutant says nothing."""
    apply = ["git", "apply", "--recount", "-C1", str(patch)]
    if subprocess.run(apply, cwd=folder, capture_output=True, check=False).returncode:
        return "DOES NOT APPLY: write the patch anew"
    result = run_tests(folder, [test_of(patch)])
    subprocess.run([*apply[:2], "--reverse", *apply[2:]], cwd=folder, check=True)
    return {"failed": "killed", "passed": "SURVIVED"}.get(result, "DID NOT RUN") + f" by {test_of(patch)}"


def main(wanted: list[str]) -> int:
    """1 where a mutant is not killed, or a test fails without one."""
    patches = sorted((ROOT / "tests" / "mutants").glob("*.patch"))
    chosen = [one for one in patches if not wanted or any(part in one.stem for part in wanted)]
    n_killed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("sb3_actpc", "tests", "docs"):
            shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", folder)
        without = run_tests(folder, sorted({test_of(patch) for patch in chosen}))
        print(f"without a mutant the tests {without}", flush=True)
        if without != "passed":
            return 1
        for patch in chosen:
            result = outcome(folder, patch)
            n_killed += result.startswith("killed")
            print(f"{patch.stem:40} {result}", flush=True)
    print(f"{n_killed} of {len(chosen)} killed")
    return int(n_killed < len(chosen))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
