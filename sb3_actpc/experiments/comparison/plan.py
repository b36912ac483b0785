"""From tasks, algorithms and seeds to a list of runs, each with an id made from its content and a folder of its own."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from sb3_actpc.demonstrations import fit_demonstrations
from sb3_actpc.experiments.comparison.variants import (
    OF_TASKS,
    OF_VARIANTS,
    find_variant,
    parse_variant,
    part_of_run,
)
from sb3_actpc.experiments.runs import Run, resolve
from sb3_actpc.experiments.runs.environments import check_env_id, make_train_env
from sb3_actpc.experiments.runs.presets import CAN_BE_NONE, read_yaml
from sb3_actpc.experiments.runs.schema import MAX_SEED, Count, Schema, Seed, merged
from sb3_actpc.utils.files import folder_name

OWN_KEYS = ("envs", "algos", "seeds", "first_seed", "output")


class Comparison(Schema):
    """Which runs are compared: every task with every variant and every seed. ValueError for a wrong number of seeds."""

    tasks: tuple[Run, ...]  # parts of runs, with ``env``
    variants: tuple[Run, ...]  # parts of runs, with a name and an algorithm
    seeds: Count = 3  # how many
    first_seed: Seed = 0  # report seeds on which no setting was chosen
    shared: Run = Run()  # what holds for all runs; a task's own comes first, and a variant's before that
    output: str = "runs/comparison"  # folder


def read_comparison(given: Mapping[str, Any]) -> Comparison:
    """:param given: ``envs`` (ids, or mappings with ``env`` and other keys of a :class:`~sb3_actpc.experiments.runs.Run`;
        ``task`` names an entry, for an environment with several sets of demonstrations),
        ``algos`` (names, or mappings: see :func:`~sb3_actpc.experiments.comparison.variants.parse_variant`), ``seeds``,
        ``first_seed``, ``output``, and keys of a run that hold for all. Values of None count
        as not given, but for ``noise_type`` and ``normalize``, where they leave the preset's out
    :return: the comparison
    :raises ValueError: when a key is unknown or a value is wrong
    """
    given = {str(key): value for key, value in given.items() if value is not None or key in CAN_BE_NONE}
    own = {key: given.pop(key) for key in OWN_KEYS if key in given}
    shared = part_of_run({"continuable": False, **given}, OWN_KEYS, (*OF_TASKS, *OF_VARIANTS))
    variants = [parse_variant(entry) for entry in _list(own, "algos")]
    tasks = [_parse_task(entry) for entry in _list(own, "envs")]
    if not tasks:
        raise ValueError("no task to compare on: give at least one, such as --envs SparseHopper-v5")
    if not variants:
        raise ValueError("no algorithm to compare: give at least one, such as --algos actpc")
    _check_names([task.task or task.env for task in tasks])
    _check_names([str(variant.name) for variant in variants])
    rest = {key: own[key] for key in ("seeds", "first_seed", "output") if key in own}
    comparison = Comparison(tasks=tuple(tasks), variants=tuple(variants), shared=shared, **rest)
    if (last := comparison.first_seed + comparison.seeds - 1) > MAX_SEED:
        raise ValueError(f"the last seed, {last}, must be at most {MAX_SEED}: give fewer seeds, or a smaller first_seed")
    return comparison


def read_comparison_file(path: Path) -> dict[str, Any]:
    """The content of a YAML file with the keys of :func:`read_comparison`."""
    if not path.is_file():
        raise FileNotFoundError(f"no comparison file at {path}")
    content = read_yaml(path.read_bytes(), str(path))
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a mapping with envs, algos, seeds, n_timesteps and output")
    return content


def with_options(content: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a file, with options instead of its values; a name of its own variants stands for that variant.
    ValueError for a name that neither the file nor the package knows."""
    content, options = dict(content), dict(options)
    if "steps" in options:  # a file may call them n_timesteps
        content.pop("n_timesteps", None)
    if "algos" in options:
        mappings = [entry for entry in content.get("algos") or [] if isinstance(entry, Mapping)]
        own = {str(parse_variant(entry).name): entry for entry in mappings}
        for name in options["algos"]:
            if name not in own:
                find_variant(name, own)
        options["algos"] = [own.get(name, name) for name in options["algos"]]
    return {**content, **options}


def plan_runs(comparison: Comparison, folder: Path | None = None) -> list[Run]:
    """Fill in and check every run before any is begun: the first seed of everything, then the second, ... Their folders are
    ``<task>/<variant>/seed<seed>_<id>`` in ``folder``, by default the comparison's. ValueError when a name or a setting is
    unknown or wrong, FileNotFoundError when a preset or a demonstrations file does not exist, gymnasium.error.Error when a
    task is unknown."""
    folder = Path(comparison.output) if folder is None else folder
    filled = [_fill(comparison.shared, task, variant) for task in comparison.tasks for variant in comparison.variants]
    names: dict[tuple[str | None, str], str | None] = {}
    for run in filled:
        other = names.setdefault((run.task, run.id), run.name)
        if other != run.name:
            raise ValueError(f"{run.task}: {other!r} and {run.name!r} have the same settings: leave one out")
    for run in {(run.env, repr(run.env_kwargs), run.demonstrations, _limits(run)): run for run in filled}.values():
        _check_environment(run)
    seeds = range(comparison.first_seed, comparison.first_seed + comparison.seeds)
    seeded = [run.model_copy(update={"seed": seed}) for seed in seeds for run in filled]
    own = [folder / folder_name(str(run.task)) / str(run.name) / f"seed{run.seed}_{run.id}" for run in seeded]
    return [run.model_copy(update={"output": str(place)}) for run, place in zip(seeded, own, strict=True)]


def _fill(shared: Run, task: Run, variant: Run) -> Run:
    module, colon, name = task.env.rpartition(":")
    env = f"{module}{colon}{name.replace('Sparse', variant.task_prefix or 'Sparse', 1)}"
    run = Run(**{**merged(shared, task, variant), "env": env, "task": task.task or task.env, "progress": False})
    check_env_id(env, run.gym_packages)
    try:
        return resolve(run)
    except (ValueError, FileNotFoundError) as error:
        raise type(error)(f"{task.env}, {variant.name}: {error}") from error


def _check_environment(run: Run) -> None:
    """Keywords and demonstrations that were given for it: wrong ones are to end the command and not each of its runs."""
    own_demonstrations = run.demonstrations not in ("shipped", "none")
    if not (own_demonstrations or run.env_kwargs):
        return
    try:
        with closing(make_train_env(run.env, run.env_kwargs, 1, run.seed)) as env:
            if own_demonstrations:
                fit_demonstrations(run.demonstrations, env, env.observation_space, env.action_space, *_limits(run))
    except ValueError as error:
        raise ValueError(f"{run.task}: {error}") from error


def _limits(run: Run) -> tuple[Any, Any]:
    return run.settings.get("n_demonstrations"), run.settings.get("n_demonstration_transitions")


def _parse_task(entry: Any) -> Run:
    entry = {"env": entry} if isinstance(entry, str) else entry
    if not isinstance(entry, Mapping) or "env" not in entry:
        raise ValueError(f"expected a Gymnasium id or a mapping with env, found {entry!r}")
    given = {str(key): value for key, value in entry.items()}
    label = given.pop("task", None)
    return Run(**merged(part_of_run(given, ("task",), elsewhere=OF_VARIANTS), Run(task=label) if label else Run()))


def _list(given: Mapping[str, Any], name: str) -> list[Any]:
    entries = given.get(name, [])
    if not isinstance(entries, (list, tuple)):
        raise ValueError(f"{name} must be a list, found {entries!r}")
    return list(entries)


def _check_names(names: Sequence[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{twice[0]!r} is given twice: leave one out, or give it another name")
