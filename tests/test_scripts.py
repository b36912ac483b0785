"""The scripts beside the tests, as far as they can be tried quickly."""

import re
from pathlib import Path

import pytest

from tests import sb3_suite

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(("ci", "code"), [("1", 1), ("", 0)])
def test_sb3s_own_tests_are_not_passed_over_in_silence(
    ci: str, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without the archive nothing is tested: a failure where nobody reads, a loud line where somebody does."""
    monkeypatch.setattr(sb3_suite, "fetch_archive", lambda: None)
    monkeypatch.setattr("sys.argv", ["sb3_suite.py"])
    monkeypatch.setenv("CI", ci)
    assert sb3_suite.main() == code
    assert "SKIPPED" in capsys.readouterr().out


def test_tests_import_helpers_and_not_each_other() -> None:
    """A test file that another one imports cannot be changed, or run, by itself."""
    borrowed = re.compile(r"^(from|import) \S*\btest_\w+", re.MULTILINE)
    files = [path for folder in ("tests", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    assert [path.name for path in files if borrowed.search(path.read_text(encoding="utf-8"))] == []
