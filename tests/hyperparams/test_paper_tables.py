"""The presets hold every value of the paper's tables (arXiv 2209.09174), which ``paper_tables.csv`` has."""

import csv
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from sb3_actpc.actpc.policies import CIRCUIT_KEYWORDS
from sb3_actpc.demonstrations.dataset import Demonstrations, shipped_demonstrations
from sb3_actpc.experiments.runs import load_preset
from sb3_actpc.experiments.runs.algorithms import load_algorithm
from sb3_actpc.utils.constructors import constructor_keywords

FILE = Path(__file__).with_name("paper_tables.csv")
ENTRIES = list(csv.DictReader(FILE.read_text(encoding="utf-8").splitlines()))
MUJOCO, ROBOSUITE = ("Reacher", "HalfCheetah", "Walker2d", "Hopper", "Swimmer"), ("Lift", "PickPlaceCan")
PRESETS = {"actpc": "actpc_paper", "td3": "td3", "her": "her", "logo": "logo", "ddpg": "ddpg"}
# number of each table in the paper -> its method and tasks
TABLES = {
    **{number: (method, MUJOCO[:3]) for number, method in (("4", "actpc"), ("5", "td3"), ("6", "her"), ("7", "logo"))},
    **{number: (method, MUJOCO[3:]) for number, method in (("8", "actpc"), ("9", "td3"), ("10", "her"), ("11", "logo"))},
    **{"12": ("actpc", ROBOSUITE), "13": ("ddpg", ROBOSUITE)},
}
# what a key can be beside the names of our settings, of which the first that is set counts
LEFT_OUT = "none: "  # and why there is nothing to compare
CAPACITY = "at least the shipped demonstrations"
UNSET: Any = object()
# what the faithful preset changes of the paper's (its comment names these rungs)
RUNGS = {
    "settling",
    "observation_normalization",
    "policy_kwargs.actor_kwargs.memory_weight",
    "n_demonstrations",
    "refresh_weight",
    "guidance",
    "guidance_kwargs.bc_updates",
    "guidance_kwargs.critic_warmup",
    "guidance_kwargs.q_filter",
    "guidance_kwargs.weighting",
}


def cases() -> list[tuple[str, str, str]]:
    """(method, task, environment id) of every column of the tables."""
    found = []
    for method, tasks in dict.fromkeys((method, tasks) for method, tasks in TABLES.values()):
        name = "Goal" if method == "her" else "Sparse"
        versions = ("v0",) if tasks is ROBOSUITE else ("v5", "v4")
        found += [(method, task, f"{name}{task}-{version}") for task in tasks for version in versions]
    return found


def look_up(settings: Mapping[str, Any], path: str, algorithm: Any) -> Any:
    """The value under a dotted key, else the constructor's default: the policy's for the policy's keywords."""
    first, _, rest = path.partition(".")
    node: Any = settings
    for part in path.split("."):
        node = node.get(part, UNSET) if isinstance(node, Mapping) else UNSET
    if node is not UNSET:
        return node
    if first == "policy_kwargs":
        return default_of(next(iter(algorithm.policy_aliases.values())), rest)
    return UNSET if rest else default_of(algorithm, first)


def default_of(kind: type, name: str) -> Any:
    """Of a constructor's keyword; a subclass may pass it on to the class above."""
    signatures = [inspect.signature(vars(base)["__init__"]).parameters for base in kind.__mro__ if "__init__" in vars(base)]
    return next((parameters[name].default for parameters in signatures if name in parameters), UNSET)


def is_papers(value: Any, expected: str) -> bool:
    """Whether one of our values is the paper's: a list of sizes, a class by its name, a number however it is written."""
    text = value.__name__ if isinstance(value, type) else " ".join(map(str, value)) if isinstance(value, list) else str(value)
    return text.lower() == expected or (isinstance(value, int | float) and float(value) == float(expected))


def test_the_file_has_every_row_of_every_table() -> None:
    for number, (method, tasks) in TABLES.items():
        rows = [entry for entry in ENTRIES if number in entry["tables"].split()]
        assert {entry["method"] for entry in rows} == {method}, number
        assert all(entry[task] for entry in rows for task in tasks), number
        assert {"phi", "dims", "rule", "eta", "gamma", "N_mem", "N_demo_mem", "N_batch"} <= {row["setting"] for row in rows}


@pytest.mark.parametrize(("method", "task", "env_id"), cases())
def test_the_preset_has_the_papers_values(method: str, task: str, env_id: str) -> None:
    settings, algorithm = load_preset(PRESETS[method], env_id), load_algorithm(method)
    shipped = Demonstrations.load(shipped_demonstrations(env_id.replace("Goal", "Sparse").replace("-v4", "-v5")))
    differing = []
    for entry in (entry for entry in ENTRIES if entry["method"] == method and entry[task]):
        key, expected = entry["key"], entry[task]
        if key == CAPACITY:
            assert len(shipped) <= int(expected)
        elif not key.startswith(LEFT_OUT):
            found = [look_up(settings, path, algorithm) for path in key.split()]
            value = next(candidate for candidate in found if candidate is not UNSET)
            if not is_papers(value, expected):
                differing.append(f"{entry['setting']} of {entry['circuit']} ({key}): {value!r}, the paper's is {expected}")
    assert not differing


# of the run, of the computation, or of nothing that the paper's preset turns on
NOT_OF_THE_AGENT = set(
    "policy env device seed verbose tensorboard_log optimize_memory_usage replay_buffer_class "
    "guidance_kwargs demonstrations".split()
)
OF_THE_AGENT = {"settling"}  # among the circuits' keywords


def test_the_papers_preset_leaves_nothing_to_defaults() -> None:
    """The constructor's defaults may become any recipe; the paper's preset stays what it is."""
    algorithm = load_algorithm("actpc")
    for env_id in ("SparseHopper-v5", "SparseLift-v0"):
        settings = load_preset("actpc_paper", env_id)
        assert not set(constructor_keywords(algorithm)) - NOT_OF_THE_AGENT - set(settings)
        assert set(settings["policy_kwargs"]["circuit_kwargs"]) == CIRCUIT_KEYWORDS - OF_THE_AGENT


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings under dotted keys."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return found


@pytest.mark.parametrize("env_id", [env_id for method, _, env_id in cases() if method == "actpc"])
def test_the_faithful_preset_is_the_papers_but_for_its_rungs(env_id: str) -> None:
    paper, faithful = flat(load_preset("actpc_paper", env_id)), flat(load_preset("actpc_faithful", env_id))
    differing = {key for key in paper | faithful if paper.get(key, UNSET) != faithful.get(key, UNSET)} - {"n_timesteps"}
    assert differing == (RUNGS - {"n_demonstrations"} if "-v0" in env_id else RUNGS)
