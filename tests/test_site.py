"""The documentation builds without a warning and without a network."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# nothing answers there: whatever is downloaded fails
NO_NETWORK = dict.fromkeys(("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"), "http://127.0.0.1:9")


def test_the_command_of_the_contributors_page_builds_every_page(tmp_path: Path) -> None:
    for extra in ("sphinx", "furo", "myst_nb", "sklearn"):
        pytest.importorskip(extra)
    text = (ROOT / "docs" / "contributing.md").read_text(encoding="utf-8")
    [options] = re.findall(r"python -m sphinx (.*) docs docs/_build", text)
    command = [sys.executable, "-m", "sphinx", *options.split(), "docs", str(tmp_path / "site")]
    built = subprocess.run(command, cwd=ROOT, env={**os.environ, **NO_NETWORK}, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout[-3000:] + built.stderr[-3000:]
    sources = {path.relative_to(ROOT / "docs").with_suffix("") for path in (ROOT / "docs").rglob("*.md")}
    pages = {path.relative_to(tmp_path / "site").with_suffix("") for path in (tmp_path / "site").rglob("*.html")}
    assert len(sources) > 15 and sources <= pages
