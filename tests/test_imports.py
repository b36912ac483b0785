"""Dependencies point one way: read from the source (nothing is imported but in the last tests)."""

import ast
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "sb3_actpc"
# each is large, or an extra that may not be installed
LAZY = ("h5py", "minari", "ray", "rl_zoo3", "robosuite", "scipy")
HEAVY = (
    "torch",
    "stable_baselines3",
    "matplotlib",
    "mujoco",
    "sb3_actpc.actpc",
    "sb3_actpc.demonstrations",
    "sb3_actpc.experiments",
    "sb3_actpc.ngc",
)


@dataclass(frozen=True)
class Import:
    """One import statement: the module it stands in, what it names, and whether it runs on import of that module."""

    module: str
    target: str
    is_lazy: bool


def module_name(path: Path) -> str:
    """``sb3_actpc/ngc/circuit.py`` -> ``sb3_actpc.ngc.circuit``."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(path: Path) -> list[Import]:
    """Every import statement of a file, relative ones made absolute; ``from a import b`` is ``a.b``: b may be a module."""
    module = module_name(path)
    package = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    found: list[Import] = []

    def visit(node: ast.AST, is_lazy: bool) -> None:
        if isinstance(node, ast.Import):
            found.extend(Import(module, alias.name, is_lazy) for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            found.extend(Import(module, f"{source}.{alias.name}", is_lazy) for alias in node.names)
        is_function = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        for child in ast.iter_child_nodes(node):
            visit(child, is_lazy or is_function or is_type_checking(node))

    visit(ast.parse(path.read_text(encoding="utf-8")), False)
    return found


def is_type_checking(node: ast.AST) -> bool:
    """Whether the node is ``if TYPE_CHECKING:``."""
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def is_within(target: str, package: str) -> bool:
    """Whether a dotted name is a package or something in it."""
    return target == package or target.startswith(f"{package}.")


IMPORTS = [entry for path in sorted(PACKAGE.rglob("*.py")) for entry in imports_of(path)]


def imports_in(package: str) -> list[Import]:
    """The imports of all modules of a package."""
    return [entry for entry in IMPORTS if is_within(entry.module, package)]


def test_ngc_imports_torch_the_standard_library_and_itself_only() -> None:
    allowed = {"torch", *sys.stdlib_module_names}
    others = [
        entry
        for entry in imports_in("sb3_actpc.ngc")
        if entry.target.split(".")[0] not in allowed and not is_within(entry.target, "sb3_actpc.ngc")
    ]
    assert others == []


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [
        ("utils", ("sb3_actpc.actpc", "sb3_actpc.experiments.runs", "sb3_actpc.cli", "sb3_actpc.ActPC")),
        ("envs", ("torch", "stable_baselines3", "sb3_actpc.actpc", "sb3_actpc.ngc", "sb3_actpc.cli")),
        ("demonstrations", ("torch", "sb3_actpc.actpc", "sb3_actpc.experiments")),
        ("checkpoints", tuple(f"sb3_actpc.{name}" for name in ("actpc", "baselines", "demonstrations", "ngc", "ActPC"))),
        ("actpc", ("sb3_actpc.experiments", "sb3_actpc.cli")),
        ("guidance", ("sb3_actpc.actpc", "sb3_actpc.experiments")),
        ("experiments.runs", ("sb3_actpc.experiments.comparison", "sb3_actpc.cli")),
    ],
)
def test_dependencies_point_one_way(package: str, forbidden: tuple[str, ...]) -> None:
    imports = imports_in(f"sb3_actpc.{package}")
    assert imports and [one for one in imports if any(is_within(one.target, name) for name in forbidden)] == []


def test_what_a_package_keeps_to_itself_is_imported_by_no_other() -> None:
    def package(name: str) -> list[str]:
        return name.split(".")[:2]

    private = [entry for entry in IMPORTS if entry.target.startswith("sb3_actpc.") and "._" in entry.target.replace("__", "")]
    assert [entry for entry in private if package(entry.module) != package(entry.target)] == []


def test_nobody_imports_the_command_line() -> None:
    importers = {entry.module for entry in IMPORTS if is_within(entry.target, "sb3_actpc.cli")}
    assert {name for name in importers if not is_within(name, "sb3_actpc.cli")} == {"sb3_actpc.__main__"}


@pytest.mark.parametrize("package", LAZY)
def test_extras_are_imported_inside_functions_only(package: str) -> None:
    assert [entry for entry in IMPORTS if is_within(entry.target, package) and not entry.is_lazy] == []


@pytest.mark.parametrize("package", HEAVY)
def test_the_command_line_imports_heavy_modules_inside_functions_only(package: str) -> None:
    """``--help`` and mistyped arguments are answered at once."""
    heavy = [entry for entry in imports_in("sb3_actpc.cli") if is_within(entry.target, package) and not entry.is_lazy]
    assert heavy == []


@pytest.mark.parametrize(
    ("statement", "loaded", "left_out"),
    [
        ("import sb3_actpc", "sb3_actpc", LAZY),
        ("from sb3_actpc import ActPC; ActPC.__name__", "sb3_actpc.actpc", LAZY),
        ("from sb3_actpc import Demonstrations", "sb3_actpc.demonstrations", ("torch", "stable_baselines3", "mujoco", "h5py")),
        ("from sb3_actpc.cli import main; main(['list', 'presets'])", "actpc_paper", HEAVY),  # it is printed, too
    ],
)
def test_what_a_statement_imports_leaves_the_rest_alone(statement: str, loaded: str, left_out: tuple[str, ...]) -> None:
    code = f"{statement}; import sys; print(' '.join(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent, check=False)
    assert result.returncode == 0, result.stderr
    found = set(result.stdout.split())
    assert loaded in found and found.isdisjoint(left_out)
