"""What docs/paper.md names exists."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")


def names_in(path: Path) -> set[str]:
    """Functions and classes of a module, and ``Class.method``."""
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{part.name}" for part in node.body if isinstance(part, ast.FunctionDef)}
    return found


def test_the_files_and_functions_that_the_paper_is_mapped_to_exist() -> None:
    references = re.findall(r"`([\w/.]+\.(?:py|yml|csv))(?::([\w.]+))?`", TEXT)
    assert len(references) > 50
    for file, name in references:
        path = next((folder / file for folder in (ROOT / "sb3_actpc", ROOT) if (folder / file).is_file()), None)
        assert path is not None, file
        assert not name or name in names_in(path), f"{file}:{name}"


def test_every_difference_that_is_referred_to_is_listed() -> None:
    tables, _, listed = TEXT.partition("\n## Differences from the paper\n")
    numbers = [int(number) for number in re.findall(r"^(\d+)\. \*\*", listed, flags=re.MULTILINE)]
    assert numbers == list(range(1, len(numbers) + 1))
    referred = {int(number) for number in re.findall(r"\bD(\d+)\b", tables)}
    assert referred <= set(numbers) and len(referred) >= 10
