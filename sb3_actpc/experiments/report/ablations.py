"""What each part of ActPC is worth: the base with every part beside the runs without each in turn."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sb3_actpc.experiments.comparison.variants import ablation_variants
from sb3_actpc.experiments.report import figures
from sb3_actpc.experiments.report.cells import interval, mean_and_deviation, number
from sb3_actpc.experiments.report.document import Block, Heading, Paragraph, Picture, Table
from sb3_actpc.experiments.report.references import measure_of
from sb3_actpc.experiments.report.results import Group, RunResult
from sb3_actpc.experiments.report.statistics import mean_interval

NO_EFFECT = "NO: the part did nothing"
_LAYER = re.compile(r"train/actor_(cosine|ratio)_(\d+)")


def ablation_groups(groups: Sequence[Group]) -> list[tuple[Group, str]]:
    """
    :param groups: of one task
    :return: the base and the ablations among them with what each leaves out, the base first; empty without base or ablation
    """
    by_name = {group.variant: group for group in groups}
    variants = ablation_variants()
    found = [(by_name[variant.name], variant.about) for variant in variants if variant.name in by_name]
    return found if variants[0].name in by_name and len(found) > 1 else []


def without_effect(groups: Sequence[Group]) -> list[str]:
    """Ablations whose removal of a part changed not one action in any seed.

    :param groups: of one task
    :return: their names
    """
    found = [group for group, _ in ablation_groups(groups)]
    return [group.variant for group in found[1:] if changed_actions(found[0], group) is False]


def changed_actions(base: Group, other: Group) -> bool | None:
    """
    :param base: runs with every part
    :param other: runs without one
    :return: whether the actions of training differ for some seed that both have; None without a common seed or episode
    """
    theirs = {run.seed: run for run in other.runs}
    pairs = [(_checksums(run), _checksums(theirs[run.seed])) for run in base.runs if run.seed in theirs]
    pairs = [(one, two) for one, two in pairs if len(one) and len(two)]
    if not pairs:
        return None
    return any(not np.array_equal(one, two) for one, two in pairs)


def ablation_blocks(groups: Sequence[Group], task: str, folder: Path) -> list[Block]:
    """
    :param groups: of one task
    :param task: its name
    :param folder: where the figure goes
    :return: blocks of the report; none without ablations
    """
    found = ablation_groups(groups)
    if not found:
        return []
    picture, measure = f"ablations_{task}.png", measure_of(task)
    figures.draw_ablation(
        [group for group, _ in found], [group.variant for group, _ in found], measure, task, folder / picture
    )
    base = found[0][0]
    rows = [_row(base, group, about, measure) for group, about in found]
    name = f"evaluation: {figures.MEASURE_NAMES[measure]}"
    header = ["", "", "seeds", name, "95 % interval", "actions changed", "gradient that arrives, by layer"]
    return [
        Heading(f"What each part is worth: {task}"),
        Paragraph(
            "The last column compares, layer by layer from the input, the actor's change with the deterministic policy "
            "gradient at the end of training: cosine of the two, and ratio of their norms (mean over seeds)."
        ),
        Table(header, rows),
        Picture(picture, f"{task}: ablations, mean and 95 % interval over seeds"),
    ]


def arriving_gradient(run: RunResult) -> list[tuple[float, float]]:
    """
    :param run: of ActPC
    :return: of each layer of the actor, the last cosine and ratio of norms that it logged; empty where it logged none
    """
    layers: dict[int, dict[str, float]] = {}
    for column, values in run.diagnostics.items():
        match = _LAYER.fullmatch(column)
        known = values[~np.isnan(values)]
        if match and len(known):
            layers.setdefault(int(match.group(2)), {})[match.group(1)] = float(known[-1])
    return [(layers[layer]["cosine"], layers[layer]["ratio"]) for layer in sorted(layers)]


def _row(base: Group, group: Group, about: str, measure: str) -> list[str]:
    values, form = group.last(measure), ".2f" if measure == "success_rate" else ".1f"
    _, low, high = (float(one) for one in mean_interval(values))
    changed = "" if group is base else {True: "yes", False: NO_EFFECT, None: "unknown"}[changed_actions(base, group)]
    arriving = [layers for run in group.runs if (layers := arriving_gradient(run))]
    gradient = (
        "; ".join(f"{number(cosine, '.2f')}, {number(ratio, '.2g')}" for cosine, ratio in np.mean(arriving, axis=0))
        if arriving
        else ""
    )
    return [
        group.variant,
        about,
        str(len(values)),
        mean_and_deviation(values, form),
        interval((low, high), form),
        changed,
        gradient,
    ]


def _checksums(run: RunResult) -> np.ndarray:
    return run.episode_values("actions_crc32")
