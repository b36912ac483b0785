"""The README and what stands beside it: commands that exist, links that lead somewhere, code that runs."""

import re
import shlex
from functools import wraps
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from sb3_actpc import ActPC
from sb3_actpc.cli import build_parser
from sb3_actpc.demonstrations import Demonstrations
from sb3_actpc.experiments.comparison import plan_runs, read_comparison
from sb3_actpc.experiments.runs.presets import read_yaml

ROOT = Path(__file__).parents[1]
PAGES = ["README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))]


def blocks(page: str, language: str) -> list[str]:
    """The code blocks of a page."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)


def commands(page: str) -> list[str]:
    """Every call of ``sb3-actpc`` in a page's shell blocks, variables filled in; rl-zoo3 reads its own options."""
    found, variables = [], {}
    for line in "".join(blocks(page, "bash")).splitlines():
        words = shlex.split(line, comments=True)
        if len(words) == 1 and "=" in words[0]:
            variables[f"${words[0].partition('=')[0]}"] = words[0].partition("=")[2]
            continue
        text = shlex.join(shlex.split(variables[words[0]]) + words[1:]) if words and words[0] in variables else line
        found += [part.strip() for part in text.split("&&") if part.strip().startswith("sb3-actpc")]
    return [command for command in found if not command.startswith("sb3-actpc zoo")]


@pytest.mark.parametrize("page", PAGES)
def test_every_command_is_one_that_the_command_line_takes(page: str) -> None:
    for command in commands(page):
        build_parser().parse_args(shlex.split(command, comments=True)[1:])  # exits where it does not


def test_the_commands_are_found() -> None:
    assert len(commands("README.md")) >= 1


@pytest.mark.parametrize("page", PAGES)
def test_every_link_inside_the_repository_leads_to_a_file(page: str) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", (ROOT / page).read_text(encoding="utf-8")):
        file, _, heading = target.partition("#")
        if file.startswith("http"):
            continue
        path = (ROOT / page).parent / file if file else ROOT / page
        assert path.exists(), f"{page}: {target}"
        if heading:
            names = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
            assert heading in [re.sub(r"[^\w -]", "", name.lower()).replace(" ", "-") for name in names], f"{page}: {target}"


def test_the_ci_runs_the_test_command_of_the_readme() -> None:
    [command] = [line for block in blocks("README.md", "bash") for line in block.splitlines() if "pytest" in line]
    assert command in (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()


def test_the_circuit_of_the_readme_learns() -> None:
    [block] = [block for block in blocks("README.md", "python") if "NGCCircuit" in block]
    torch.manual_seed(0)
    names: dict[str, Any] = {}
    exec(block, names)
    circuit, x, target = names["circuit"], names["x"], names["target"]
    energies = []
    for _ in range(50):
        circuit.apply_changes(circuit.hebbian_update(circuit.settle(x, target)))
        energies.append(float(((circuit.project(x) - target) ** 2).mean()))
    assert energies[-1] < energies[0]


SNIPPETS = [(page, index) for page in PAGES for index in range(len(blocks(page, "python")))]


@pytest.mark.parametrize(("page", "index"), SNIPPETS)
def test_every_snippet_runs_as_written_by_itself_and_shows_something(page, index, tmp_path, monkeypatch, capsys) -> None:
    """Only training is shortened."""
    learn, init = ActPC.learn, ActPC.__init__

    def learn_a_little(self: ActPC, total_timesteps: int, *args: Any, **options: Any) -> ActPC:
        return learn(self, min(total_timesteps, 40), *args, **options)

    @wraps(init)
    def clone_a_little(self: ActPC, *args: Any, **options: Any) -> None:
        short = {"guidance_kwargs": {"bc_updates": 20}} if options.get("demonstrations") is not None else {}
        init(self, *args, **{**short, **options})

    monkeypatch.setattr(ActPC, "learn", learn_a_little)
    monkeypatch.setattr(ActPC, "__init__", clone_a_little)
    monkeypatch.chdir(tmp_path)
    exec(blocks(page, "python")[index], {"__name__": "__main__"})
    assert capsys.readouterr().out.strip()


def test_demonstrations_recorded_as_the_readme_says_train_an_agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for block in blocks("README.md", "python")[1:3]:
        names: dict[str, Any] = {}
        exec(block, names)
        ActPC("MlpPolicy", "Pendulum-v1", demonstrations=names["recorded"])
    assert Demonstrations.load("mine.npz").n_episodes == 20


def test_the_steps_of_the_hopper_are_the_preset_s() -> None:
    entries = read_yaml((ROOT / "hyperparams" / "actpc.yml").read_bytes(), "actpc.yml")
    text = "".join((ROOT / page).read_text(encoding="utf-8") for page in ("README.md", "docs/getting_started.md"))
    numbers = [int(number.replace("_", "")) for number in re.findall(r"(?:\.learn\(| -n )([\d_]{4,})", text)]
    assert set(numbers) == {entries["SparseHopper-v5"]["n_timesteps"]}


def test_the_file_of_the_comparisons_page_is_one() -> None:
    [block] = blocks("docs/comparisons.md", "yaml")
    comparison = read_comparison(yaml.safe_load(block))
    assert [len(comparison.tasks), len(comparison.variants), comparison.seeds] == [2, 3, 5]
    assert [len(plan_runs(comparison, Path("none")))] == [2 * 3 * 5]
