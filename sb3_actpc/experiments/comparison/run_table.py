"""From tasks, algorithms and seeds to a table of runs, each with an id made from its content and a folder of its own."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import yaml

from sb3_actpc.experiments.comparison.variants import Variant, ablation_variants, parse_variant
from sb3_actpc.experiments.runs import RunConfig
from sb3_actpc.experiments.runs.config import resolve_run
from sb3_actpc.experiments.runs.record import describe_plan
from sb3_actpc.experiments.runs.run import check_env_id

# what decides the outcome of a run, apart from its seed; keys of ``config.json``
CONTENT = (
    "algo",
    "env",
    "env_kwargs",
    "policy",
    "n_timesteps",
    "n_envs",
    "noise",
    "normalize",
    "settings",
    "demonstrations_sha256",
    "eval_freq",
    "eval_episodes",
)


@dataclass(frozen=True)
class Task:
    """A task of a comparison.

    :param env: Gymnasium id
    :param env_kwargs: its keywords, added to the presets'
    :param demonstrations: as :class:`~sb3_actpc.experiments.runs.RunConfig` has it; by default the comparison's
    :param n_timesteps: environment steps; by default the comparison's
    """

    env: str
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    demonstrations: str | None = None
    n_timesteps: int | None = None


@dataclass(frozen=True)
class Comparison:
    """Which runs are compared.

    :param tasks: at least one
    :param variants: at least one
    :param seeds: how many seeds; they are 0, 1, ...
    :param n_timesteps: environment steps of each run; by default the presets'. A variant's own come first, then a task's
    :param demonstrations: as :class:`~sb3_actpc.experiments.runs.RunConfig` has it, as the next five
    :param eval_freq: environment steps between two evaluations
    :param eval_episodes: episodes in each evaluation
    :param checkpoint_freq: environment steps between two checkpoints
    :param device: torch device
    :param threads: threads of each run
    :raises ValueError: without a task, a variant or a seed, or when two variants or tasks share a name
    """

    tasks: tuple[Task, ...]
    variants: tuple[Variant, ...]
    seeds: int = 3
    n_timesteps: int | None = None
    demonstrations: str = "shipped"
    eval_freq: int | None = None
    eval_episodes: int = 10
    checkpoint_freq: int | None = None
    device: str = "cpu"
    threads: int = 1

    def __post_init__(self) -> None:
        if isinstance(self.seeds, bool) or not isinstance(self.seeds, int) or self.seeds < 1:
            raise ValueError(f"seeds={self.seeds!r} must be a whole number of at least 1: give the number of seeds")
        if not self.tasks:
            raise ValueError("no task to compare on: give at least one, such as --envs SparseHopper-v5")
        if not self.variants:
            raise ValueError("no algorithm to compare: give at least one, such as --algos actpc, or --ablate")
        for names in ([task.env for task in self.tasks], [variant.name for variant in self.variants]):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ValueError(f"{twice[0]!r} is given twice: leave one out, or give it another name")


@dataclass(frozen=True)
class PlannedRun:
    """A row of the table.

    :param id: ten hex digits made from what decides the run's outcome
    :param task: the comparison's task
    :param variant: name of the variant
    :param config: what to train, its folder among it
    """

    id: str
    task: str
    variant: str
    config: RunConfig

    @property
    def folder(self) -> Path:
        """The run's own."""
        assert self.config.output is not None
        return Path(self.config.output)

    @property
    def name(self) -> str:
        """Task, variant and seed, for people."""
        return f"{self.task} {self.variant} seed {self.config.seed}"

    @property
    def n_timesteps(self) -> int:
        """Environment steps."""
        assert self.config.n_timesteps is not None
        return self.config.n_timesteps

    def to_json(self) -> str:
        """The row as a line of JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> PlannedRun:
        """
        :param text: what :meth:`to_json` returned
        :return: the row
        """
        record = json.loads(text)
        return cls(**{**record, "config": RunConfig(**record["config"])})


def content_id(record: Mapping[str, Any], seed: int | None = None) -> str:
    """
    :param record: a run's ``config.json``, or as much of it as decides the outcome
    :param seed: the run's; None for an id that all seeds share
    :return: ten hex digits
    """
    content = {name: record.get(name) for name in CONTENT}
    if content["normalize"] is None:
        del content["normalize"]  # only some algorithms have it
    text = json.dumps({**content, "seed": seed}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def plan_runs(comparison: Comparison, folder: Path) -> list[PlannedRun]:
    """Resolve and check every run before any is begun.

    :param comparison: which runs
    :param folder: where their folders go, as ``<task>/<variant>/seed<seed>_<id>``
    :return: the table: the first seed of everything, then the second, ...
    :raises ValueError: when a name or a setting is unknown or wrong
    :raises FileNotFoundError: when a preset or a demonstrations file does not exist
    :raises gymnasium.error.Error: when a task is unknown
    """
    resolved = [
        (task, variant, *_resolve(comparison, task, variant)) for task in comparison.tasks for variant in comparison.variants
    ]
    runs = []
    for seed in range(comparison.seeds):
        for task, variant, choices, content in resolved:
            run_id = content_id(content, seed)
            own = folder / task.env.replace(":", "_") / variant.name / f"seed{seed}_{run_id}"
            config = RunConfig(**choices, seed=seed, output=str(own), progress=False)
            runs.append(PlannedRun(run_id, task.env, variant.name, config))
    return runs


def _resolve(comparison: Comparison, task: Task, variant: Variant) -> tuple[dict[str, Any], dict[str, Any]]:
    """Keywords of :class:`RunConfig`, seed and folder left out, and what decides the outcome."""
    env = variant.env_id(task.env)
    check_env_id(env)
    choices: dict[str, Any] = {
        "env": env,
        "algo": variant.algo,
        "preset": variant.preset,
        "n_timesteps": variant.n_timesteps or task.n_timesteps or comparison.n_timesteps,
        "demonstrations": comparison.demonstrations if task.demonstrations is None else task.demonstrations,
        "overrides": dict(variant.overrides),
        "env_kwargs": dict(task.env_kwargs),
        "eval_freq": comparison.eval_freq,
        "eval_episodes": comparison.eval_episodes,
        "device": comparison.device,
        "threads": comparison.threads,
        "checkpoint_freq": comparison.checkpoint_freq,
    }
    try:
        plan = resolve_run(RunConfig(**choices))
    except (ValueError, FileNotFoundError) as error:
        raise type(error)(f"{task.env}, {variant.name}: {error}") from error
    choices["n_timesteps"] = plan.n_timesteps
    own = {"algo": variant.algo, "env": env, "eval_freq": plan.eval_freq, "eval_episodes": comparison.eval_episodes}
    return choices, {**describe_plan(plan), **own}


# ------------------------------------------------------------------ reading a comparison from a file


def read_comparison(given: Mapping[str, Any]) -> Comparison:
    """
    :param given: ``envs`` (ids, or mappings with ``env`` and the parameters of :class:`Task`), ``algos`` (names, or mappings:
        see :func:`~sb3_actpc.experiments.comparison.variants.parse_variant`), ``ablate`` and the other parameters of
        :class:`Comparison`; ``steps`` is ``n_timesteps``. Values of None count as not given
    :return: the comparison
    :raises ValueError: when a key is unknown or a value is wrong
    """
    given = {"n_timesteps" if key == "steps" else str(key): value for key, value in given.items() if value is not None}
    own = {one.name for one in fields(Comparison)} - {"tasks", "variants"}
    unknown = sorted(set(given) - own - {"envs", "algos", "ablate"})
    if unknown:
        known = sorted((own - {"n_timesteps"}) | {"envs", "algos", "ablate", "steps"})
        raise ValueError(f"unknown key {unknown[0]!r}: expected some of {', '.join(known)}")
    variants = [parse_variant(entry) for entry in _list(given, "algos")]
    if given.get("ablate"):
        variants += [variant for variant in ablation_variants() if variant not in variants]
    tasks = tuple(_parse_task(entry) for entry in _list(given, "envs"))
    return Comparison(tasks, tuple(variants), **{name: value for name, value in given.items() if name in own})


def read_yaml(path: Path) -> dict[str, Any]:
    """
    :param path: a YAML file with the keys of :func:`read_comparison`, and ``out``
    :return: its content
    :raises FileNotFoundError: when there is none
    :raises ValueError: when it is not a YAML mapping
    """
    if not path.is_file():
        raise FileNotFoundError(f"no comparison file at {path}")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a YAML file ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a mapping with envs, algos, seeds, steps and out")
    return content


def _list(given: Mapping[str, Any], name: str) -> list[Any]:
    entries = given.get(name, [])
    if not isinstance(entries, (list, tuple)):
        raise ValueError(f"{name} must be a list, found {entries!r}")
    return list(entries)


def _parse_task(entry: Any) -> Task:
    if isinstance(entry, str):
        return Task(entry)
    if not isinstance(entry, Mapping) or "env" not in entry:
        raise ValueError(f"expected a Gymnasium id or a mapping with env, found {entry!r}")
    given = {"n_timesteps" if key == "steps" else str(key): value for key, value in entry.items()}
    known = {one.name for one in fields(Task)}
    unknown = sorted(set(given) - known)
    if unknown:
        raise ValueError(f"unknown key {unknown[0]!r} in {dict(entry)}: expected some of {', '.join(sorted(known))}, steps")
    return Task(**given)
