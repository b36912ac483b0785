"""What docs/paper.md names exists, docs/metrics.md names all that is logged, the pages of results have the tables of
their data."""

import ast
import importlib.util
import re
from pathlib import Path

import pytest
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor

from sb3_actpc import ActPC
from tests.actpc.agents import imitating
from tests.actpc.envs import CountingEnv

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


class Keys(KVWriter):
    """What was logged."""

    def __init__(self) -> None:
        self.logged: set[str] = set()

    def write(self, key_values, key_excluded, step=0) -> None:
        self.logged |= set(key_values)

    def close(self) -> None:
        """Nothing is open."""


@pytest.mark.parametrize("settling", ["scheduled", "iterative"])
def test_every_logged_key_is_in_the_table_of_metrics(settling: str) -> None:
    keys = Keys()
    signals = {"reward_weights": {"epistemic": 0.1, "instrumental": 0.1}, "signal_kwargs": {"prior_updates": 5}}
    guidance = {"bc_updates": 5, "critic_warmup": 5}
    model: ActPC = imitating(lambda: Monitor(CountingEnv()), settling=settling, guidance_kwargs=guidance, **signals)
    model.set_logger(Logger(None, [keys]))
    model.learn(200)
    keys_section = (ROOT / "docs" / "metrics.md").read_text(encoding="utf-8").split("\n## ")[1]
    named = re.findall(r"^\| `([\w/{}]+)` \|", keys_section, flags=re.MULTILINE)
    patterns = [name.replace("{circuit}", "(actor|critic|generator|prior)").replace("{layer}", r"\d+") for name in named]
    missing = {key for key in keys.logged if not any(re.fullmatch(pattern, key) for pattern in patterns)}
    assert missing == set()
    unseen = [name for name, one in zip(named, patterns, strict=True) if not any(re.fullmatch(one, k) for k in keys.logged)]
    optional = ("eval/", "rollout/success_rate", "train/deployed_return")  # of runs on the command line, and longer ones
    assert [name for name in unseen if not name.startswith(optional)] == []


def test_the_tables_of_the_results_are_those_of_the_data() -> None:
    spec = importlib.util.spec_from_file_location("result_tables", ROOT / "docs" / "result_tables.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    pages = [(ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("results.md", "results_details.md")]
    tables = module.tables()
    assert len(tables) > 10
    for title, lines in tables.items():
        assert any("\n".join(lines) in text for text in ([readme] if title == "summary" else pages)), title
