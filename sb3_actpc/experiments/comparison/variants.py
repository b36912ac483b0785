"""Named ways of running an algorithm: each is a part of a :class:`~sb3_actpc.experiments.runs.Run`."""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from sb3_actpc.experiments.runs import ALGORITHMS, Run
from sb3_actpc.experiments.runs.presets import CAN_BE_NONE, read_yaml
from sb3_actpc.experiments.runs.schema import merged
from sb3_actpc.utils.checks import nearest

# what the comparison itself says of each of its runs
PLANNED = ("seed", "task", "progress", "output")
OF_TASKS, OF_VARIANTS = ("env",), ("algo", "name", "task_prefix")  # keys of an entry of envs, and of algos
VARIANTS_FILE = Path(__file__).with_name("variants.yml")


def find_variant(name: str, also: Iterable[str] = ()) -> Run:
    """The variant that goes by a name: of the shipped file, or an algorithm's. ValueError for another one, which names also
    those of ``also``."""
    known = _variants()
    if name in known:
        return known[name]
    if ":" in name:  # MODULE:CLASS
        return Run(name=name.rpartition(":")[2], algo=name)
    names = [*also, *variant_names()]
    raise ValueError(f"unknown algorithm or variant {name!r}{nearest(name, names)}: expected one of {', '.join(names)}")


def parse_variant(entry: Any) -> Run:
    """The variant of a name, or of a mapping with some of the keys of :class:`~sb3_actpc.experiments.runs.Run`, where ``base``
    names the variant that it starts from; ValueError when it is neither, or has an unknown key or a wrong value."""
    if isinstance(entry, str):
        return find_variant(entry)
    if not isinstance(entry, Mapping):
        raise ValueError(f"expected the name of an algorithm or a mapping, found {entry!r}")
    given = {str(key): value for key, value in entry.items()}
    base = given.pop("base", None)
    if not isinstance(base, str | None):
        raise ValueError(f"base={base!r} must be a text: the name of the variant that this one starts from")
    own = part_of_run(given, ("base",), OF_TASKS)
    if base is not None:
        return Run(**merged(find_variant(base), own))
    if "algo" not in given:
        raise ValueError(f"{dict(entry)} has neither algo nor base: say which algorithm it is")
    return Run(**merged(Run(name=own.algo.rpartition(":")[2]), own))


def part_of_run(entry: Mapping[str, Any], also: Sequence[str] = (), elsewhere: Sequence[str] = ()) -> Run:
    """A part of a run from its keys; ``also`` are keys that stand beside them, ``elsewhere`` those of another part. ValueError
    for an unknown key, with the nearest known one, a wrong value, one of ``elsewhere``, or one that the comparison decides."""
    known = sorted({*also, *Run.known_keys()} - {*PLANNED, *elsewhere})
    for key, value in entry.items():
        if key in PLANNED:
            raise ValueError(f"{key}={value!r} cannot be given here: the comparison decides it, leave it out")
        if key in elsewhere:
            place = "envs" if key in OF_TASKS else "algos"
            raise ValueError(
                f"{key}={value!r} cannot be given here, where it counts for nothing: give it in an entry of {place}"
            )
        if key not in known:
            raise ValueError(f"unknown key {key!r}{nearest(key, known)}: expected some of {', '.join(known)}")
    return Run(**{key: value for key, value in entry.items() if value is not None or key in CAN_BE_NONE})


def variant_names() -> list[str]:
    """Every name that ``--algos`` takes."""
    return sorted(_variants())


@cache
def _read() -> dict[str, Any]:
    return read_yaml(VARIANTS_FILE.read_bytes(), str(VARIANTS_FILE))


def _variants() -> dict[str, Run]:
    """By name; a shipped variant comes before an algorithm of its name."""
    algorithms = {name: Run(name=name, algo=name) for name in ALGORITHMS}
    shipped = {name: Run(name=name, **entry) for name, entry in _read()["variants"].items() if entry["algo"] in ALGORITHMS}
    return {**algorithms, **shipped}
