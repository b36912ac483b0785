"""Every test of comparisons works in an empty folder with a small preset, which workers find too."""

from pathlib import Path

import pytest

from tests.experiments.comparison.tasks import ROOT, write_preset


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    write_preset()
