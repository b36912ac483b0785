"""What each part of ActPC is worth: the base with every part beside the runs without each in turn."""

from pathlib import Path

import numpy as np
import pandas as pd

from sb3_actpc.experiments.comparison.variants import ablation_variants
from sb3_actpc.experiments.report.figures import MEASURE_NAMES, draw_ablation
from sb3_actpc.experiments.report.page import Section, interval, mean_and_deviation, number
from sb3_actpc.experiments.report.references import measure_of
from sb3_actpc.experiments.report.results import Results
from sb3_actpc.experiments.report.statistics import mean_interval
from sb3_actpc.utils.files import folder_name

NO_EFFECT = "NO: the part did nothing"


def ablation_groups(results: Results, task: str) -> dict[str, pd.DataFrame]:
    """Label -> runs on a task, the base first and then the ablations; empty without base or ablation."""
    groups, variants = results.groups(task), ablation_variants()
    found = {variant.name: groups[variant.name] for variant in variants if variant.name in groups}
    return found if variants[0].name in found and len(found) > 1 else {}


def without_effect(results: Results, task: str) -> list[str]:
    """Names of the ablations on a task whose removal of a part changed not one action in any seed."""
    names, runs = list(found := ablation_groups(results, task)), list(found.values())
    return [name for name, own in zip(names[1:], runs[1:], strict=True) if changed_actions(results, runs[0], own) is False]


def changed_actions(results: Results, base: pd.DataFrame, other: pd.DataFrame) -> bool | None:
    """Whether the actions of training differ between runs with every part and runs without one, for some seed that both
    have; None without a common seed or episode."""
    actions = {run: rows["actions_crc32"].tolist() for run, rows in results.episodes.groupby("run")}
    ours, theirs = ({row.seed: actions.get(row.Index) for row in runs.itertuples()} for runs in (base, other))
    pairs = [(ours[seed], theirs[seed]) for seed in ours if ours[seed] and theirs.get(seed)]
    return any(one != two for one, two in pairs) if pairs else None


def ablation_sections(results: Results, task: str, folder: Path) -> list[Section]:
    """Of the report on a task, with its figure in ``folder``; none without ablations."""
    found = ablation_groups(results, task)
    if not found:
        return []
    picture, measure = f"ablations_{folder_name(task)}.png", measure_of(task)
    draw_ablation({name: runs[measure].to_numpy() for name, runs in found.items()}, measure, task, folder / picture)
    form = ".2f" if measure == "success_rate" else ".1f"
    about = {variant.name: variant.about for variant in ablation_variants()}
    base, rows = next(iter(found)), []
    for name, runs in found.items():
        values = runs[measure].to_numpy()
        _, low, high = (float(one) for one in mean_interval(values))
        changed = changed_actions(results, found[base], runs)
        arriving = [arriving_gradient(results, run) for run in runs.index]
        layers = np.mean([one for one in arriving if one] or np.empty((1, 0, 2)), axis=0)
        rows.append(
            {
                "variant": name,
                "without": about[name],
                "seeds": str(len(values)),
                f"evaluation: {MEASURE_NAMES[measure]}": mean_and_deviation(values, form),
                "95 % interval": interval((low, high), form),
                "actions changed": "" if name == base else {True: "yes", False: NO_EFFECT, None: "unknown"}[changed],
                "gradient that arrives, by layer": "; ".join(f"{number(a, '.2f')}, {number(b, '.2g')}" for a, b in layers),
            }
        )
    text = (
        "The last column compares, layer by layer from the input, the actor's change with the deterministic policy "
        "gradient at the end of training: cosine of the two, and ratio of their norms (mean over seeds)."
    )
    caption = f"{task}: ablations, mean and 95 % interval over seeds"
    return [Section(f"What each part is worth: {task}", text, pd.DataFrame(rows), picture, caption)]


def arriving_gradient(results: Results, run: str) -> list[tuple[float, float]]:
    """Of each layer of a run's actor, the last cosine and ratio of norms that it logged; empty where it logged none."""
    if results.diagnostics.empty:
        return []
    own = results.diagnostics[results.diagnostics["run"] == run].dropna(axis="columns", how="all")
    last = {name: float(own[name].dropna().iloc[-1]) for name in map(str, own) if name.startswith("train/actor_")}
    cosines = sorted(name for name in last if name.startswith("train/actor_cosine_"))
    return [(last[name], last[name.replace("cosine", "ratio")]) for name in cosines]
