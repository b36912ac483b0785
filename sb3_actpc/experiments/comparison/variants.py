"""Algorithms by name, and named ways of running them: an algorithm, a preset and settings that replace the preset's."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from sb3_actpc.experiments.runs import ALGORITHMS

VARIANTS_FILE = Path(__file__).with_name("variants.yml")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")


@dataclass(frozen=True)
class Variant:
    """A way of running an algorithm.

    :param name: names its runs' folder and its row in the report
    :param algo: key of :data:`~sb3_actpc.experiments.runs.ALGORITHMS`
    :param preset: as :class:`~sb3_actpc.experiments.runs.RunConfig` has it
    :param overrides: settings that replace the preset's
    :param about: what it is, for the report
    :param task_prefix: what the name of its task begins with, in the place of ``Sparse``
    :param n_timesteps: environment steps, where it is trained for fewer or more than the others
    :raises ValueError: when the name cannot be a folder's, or the algorithm is unknown
    """

    name: str
    algo: str
    preset: str | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)
    about: str = ""
    task_prefix: str | None = None
    n_timesteps: int | None = None

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"the name {self.name!r} must be letters, digits and . _ + -: it becomes a folder's")
        if self.algo not in ALGORITHMS:
            raise ValueError(f"{self.name}: unknown algorithm {self.algo!r}: expected one of {', '.join(sorted(ALGORITHMS))}")

    def env_id(self, task: str) -> str:
        """
        :param task: Gymnasium id of the comparison's task
        :return: id of the environment that this variant runs in
        """
        return task if self.task_prefix is None else task.replace("Sparse", self.task_prefix, 1)


def find_variant(name: str) -> Variant:
    """
    :param name: of the shipped file, or an algorithm's
    :return: the variant
    :raises ValueError: when there is no such name
    """
    record = _shipped()["variants"].get(name)
    if record is not None:
        return Variant(name=name, **record)
    if name in ALGORITHMS:
        return Variant(name=name, algo=name)
    ablations = [variant for variant in ablation_variants() if variant.name == name]
    if ablations:
        return ablations[0]
    known = variant_names()
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    raise ValueError(f"unknown algorithm or variant {name!r}{hint}: expected one of {', '.join(known)}")


def parse_variant(entry: Any) -> Variant:
    """
    :param entry: a name, or a mapping with the parameters of :class:`Variant`; ``base`` names the variant that it starts
        from, ``steps`` is ``n_timesteps``
    :return: the variant
    :raises ValueError: when it is neither, or has an unknown key
    """
    if isinstance(entry, str):
        return find_variant(entry)
    if not isinstance(entry, Mapping):
        raise ValueError(f"expected the name of an algorithm or a mapping, found {entry!r}")
    given = {"n_timesteps" if key == "steps" else str(key): value for key, value in entry.items()}
    known = {one.name for one in fields(Variant)} | {"base"}
    unknown = sorted(set(given) - known)
    if unknown:
        raise ValueError(f"unknown key {unknown[0]!r} in {dict(entry)}: expected some of {', '.join(sorted(known))}, steps")
    base = given.pop("base", None)
    if base is not None:
        start = find_variant(base)
        given["overrides"] = {**start.overrides, **given.get("overrides", {})}
        return replace(start, **given)
    if "algo" not in given:
        raise ValueError(f"{dict(entry)} has neither algo nor base: say which algorithm it is")
    return Variant(**{"name": given["algo"], **given})


def ablation_variants() -> list[Variant]:
    """ActPC with every part at work, then without each in turn."""
    [(name, record)] = _shipped()["ablation_base"].items()
    base = Variant(name=name, **record)
    parts = _shipped()["ablations"].items()
    return [base, *(replace(base, name=name, about=part["about"], overrides={**base.overrides, **part["overrides"]})
                    for name, part in parts)]  # fmt: skip


def variant_names() -> list[str]:
    """Every name that ``--algos`` takes now: the algorithms, and the variants whose algorithm is there."""
    shipped = [name for name, record in _shipped()["variants"].items() if record["algo"] in ALGORITHMS]
    return sorted({*ALGORITHMS, *shipped, *(variant.name for variant in ablation_variants())})


@cache
def _shipped() -> dict[str, Any]:
    return yaml.safe_load(VARIANTS_FILE.read_text(encoding="utf-8"))
