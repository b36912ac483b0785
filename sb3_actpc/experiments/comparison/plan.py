"""From tasks, algorithms and seeds to a list of runs, each with an id made from its content and a folder of its own. Tasks and
variants (named ways of running an algorithm) are parts of a :class:`~sb3_actpc.experiments.runs.Run`."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from itertools import groupby
from pathlib import Path
from typing import Any

from sb3_actpc.demonstrations import fit_demonstrations
from sb3_actpc.experiments.runs import ALGORITHMS, Run, resolve
from sb3_actpc.experiments.runs.environments import check_env_id, make_train_env
from sb3_actpc.experiments.runs.presets import CAN_BE_NONE, read_yaml
from sb3_actpc.experiments.runs.schema import MAX_SEED, Count, Schema, Seed, merged
from sb3_actpc.utils.checks import nearest
from sb3_actpc.utils.files import folder_name

OWN_KEYS = ("envs", "algos", "seeds", "first_seed", "output")
PLANNED = {"seed", "progress", "output"}  # what the comparison itself says of each of its runs
OF_TASKS, OF_VARIANTS = {"env", "task"}, {"algo", "name", "task_prefix"}  # keys of an entry of envs, and of algos
VARIANTS_FILE = Path(__file__).with_name("variants.yml")


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
        ``task`` names an entry, for an environment with several sets of demonstrations), ``algos`` (names, or mappings: see
        :func:`parse_variant`), ``seeds``, ``first_seed``, ``output``, and keys of a run that hold for all. None counts as not
        given, but for ``noise_type`` and ``normalize``, where it leaves the preset's out
    :return: the comparison
    :raises ValueError: when a key is unknown or a value is wrong
    """
    given = {str(key): value for key, value in given.items() if value is not None or key in CAN_BE_NONE}
    own = {key: given.pop(key) for key in OWN_KEYS if key in given}
    shared = part_of_run({"continuable": False, **given}, {*OF_TASKS, *OF_VARIANTS}, OWN_KEYS)
    variants = [parse_variant(entry) for entry in _list(own, "algos")]
    tasks = [part_of_run({"env": entry} if isinstance(entry, str) else entry, OF_VARIANTS) for entry in _list(own, "envs")]
    for names in ([task.task or task.env for task in tasks], [str(variant.name) for variant in variants]):
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"{name!r} is given twice: leave one out, or give it another name")
    comparison = Comparison(tasks=tuple(tasks), variants=tuple(variants), shared=shared, **own)
    last = comparison.first_seed + comparison.seeds - 1
    if last > MAX_SEED:
        raise ValueError(f"the last seed, {last}, must be at most {MAX_SEED}")
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
    content = dict(content)
    options = dict(options)
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
    for name, runs in groupby(filled, key=lambda run: run.task):
        _warn_of_other_environments(str(name), list(runs))
    seeds = range(comparison.first_seed, comparison.first_seed + comparison.seeds)
    seeded = [run.model_copy(update={"seed": seed}) for seed in seeds for run in filled]
    own = [folder / folder_name(str(run.task)) / str(run.name) / f"seed{run.seed}_{run.id}" for run in seeded]
    return [run.model_copy(update={"output": str(place)}) for run, place in zip(seeded, own, strict=True)]


def _fill(shared: Run, task: Run, variant: Run) -> Run:
    """One run, resolved. Keywords and demonstrations that were given for its environment are tried, too: wrong ones are to end
    the command and not each of its runs."""
    module, colon, name = task.env.rpartition(":")
    env_id = f"{module}{colon}{name.replace('Sparse', variant.task_prefix or 'Sparse', 1)}"
    run = Run(**{**merged(shared, task, variant), "env": env_id, "task": task.task or task.env, "progress": False})
    check_env_id(env_id, run.gym_packages)
    try:
        run = resolve(run)
        own_demonstrations = run.demonstrations not in ("shipped", "none")
        if own_demonstrations or run.env_kwargs:
            with closing(make_train_env(run.env, run.env_kwargs, 1, run.seed)) as env:
                if own_demonstrations:
                    fit_demonstrations(run.demonstrations, env, env.observation_space, env.action_space)
        return run
    except (ValueError, FileNotFoundError) as error:
        raise type(error)(f"{run.task}, {variant.name}: {error}") from error


def _warn_of_other_environments(task: str, runs: Sequence[Run]) -> None:
    """A preset can have keywords of its own for the environment; the returns of its variant then do not compare."""
    if any(run.env_kwargs != runs[0].env_kwargs for run in runs):
        given = ", ".join(f"{run.name} {run.env_kwargs}" for run in runs)
        warnings.warn(
            f"{task}: presets give the environment different keywords, so returns may not compare: {given}. "
            f"env_kwargs in the entry of {task} make them equal",
            stacklevel=3,
        )


def _list(given: dict[str, Any], name: str) -> list[Any]:
    entries = given.pop(name, None)
    if not isinstance(entries, (list, tuple)) or not entries:
        raise ValueError(f"{name} must be a list of at least one, found {entries!r}: see sb3-actpc list tasks, or algos")
    return list(entries)


# ---------------------------------------------------------------------- variants


def parse_variant(entry: Any) -> Run:
    """The variant of a name, or of a mapping with some of the keys of :class:`~sb3_actpc.experiments.runs.Run`, where ``base``
    names the variant that it starts from; ValueError when it is neither, or has an unknown key or a wrong value."""
    if isinstance(entry, str):
        return find_variant(entry)
    if not isinstance(entry, Mapping) or not {"algo", "base"} & entry.keys():
        raise ValueError(f"expected the name of an algorithm, or a mapping with algo or base, found {entry!r}")
    own = part_of_run({key: value for key, value in entry.items() if key != "base"}, OF_TASKS)
    base = find_variant(str(entry["base"])) if "base" in entry else Run(name=own.algo.rpartition(":")[2])
    return Run(**merged(base, own))


def part_of_run(entry: Mapping[str, Any], elsewhere: Iterable[str], also: Sequence[str] = ()) -> Run:
    """A part of a run from its keys; None counts as not given, but for ``CAN_BE_NONE``. ValueError for an unknown key, with
    the nearest of the known ones and of ``also``, a wrong value, or a key that is given ``elsewhere`` or is PLANNED."""
    if not isinstance(entry, Mapping):
        raise ValueError(f"expected a name or a mapping, found {entry!r}")
    known = sorted({*also, *Run.known_keys()} - {*PLANNED, *elsewhere})
    for key, value in entry.items():
        if key not in known:
            raise ValueError(f"unknown key {key!r} (={value!r}) here{nearest(str(key), known)}: expected some of {known}")
    return Run(**{key: value for key, value in entry.items() if value is not None or key in CAN_BE_NONE})


def find_variant(name: str, also: Iterable[str] = ()) -> Run:
    """The variant that goes by a name: of the shipped file, an algorithm's, or ``MODULE:CLASS``. ValueError for another one,
    which names also those of ``also``."""
    shipped = read_yaml(VARIANTS_FILE.read_bytes(), str(VARIANTS_FILE))["variants"]
    if name in shipped:
        return Run(name=name, **shipped[name])
    if name in ALGORITHMS or ":" in name:
        return Run(name=name.rpartition(":")[2], algo=name)
    names = [*also, *variant_names()]
    raise ValueError(f"unknown algorithm or variant {name!r}{nearest(name, names)}: expected one of {', '.join(names)}")


def variant_names() -> list[str]:
    """Every name that ``--algos`` takes."""
    return sorted({*ALGORITHMS, *read_yaml(VARIANTS_FILE.read_bytes(), str(VARIANTS_FILE))["variants"]})
