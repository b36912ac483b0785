"""The scripts beside the tests, as far as they can be tried quickly."""

import re

import pytest

from tests import sb3_suite
from tests.mutants import MUTANTS, ROOT, occurrences


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


def test_every_mutant_changes_one_line_of_the_source() -> None:
    """Running them takes long; that their lines are still there is quickly seen."""
    assert len(MUTANTS) >= 40 and len({mutant.name for mutant in MUTANTS}) == len(MUTANTS)
    assert {mutant.name: occurrences(mutant) for mutant in MUTANTS if occurrences(mutant) != 1} == {}
    assert [mutant.name for mutant in MUTANTS if mutant.old == mutant.new] == []


def test_every_mutant_names_tests_that_are_there() -> None:
    paths = {word.partition("::")[0] for mutant in MUTANTS for word in mutant.tests.split() if word.startswith("tests/")}
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []


def test_tests_import_helpers_and_not_each_other() -> None:
    """A test file that another one imports cannot be changed, or run, by itself."""
    borrowed = re.compile(r"^(from|import) \S*\btest_\w+", re.MULTILINE)
    files = [path for folder in ("tests", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    assert [path.name for path in files if borrowed.search(path.read_text(encoding="utf-8"))] == []
