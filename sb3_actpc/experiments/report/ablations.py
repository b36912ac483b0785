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
ALIKE = ["planned_steps", "demonstrations"]  # what a base and its ablations share


def ablation_groups(results: Results, task: str) -> list[dict[str, pd.DataFrame]]:
    """Label -> runs on a task, for each base: the base first, and then the ablations (none, maybe) that are like it but for
    the part that they lack."""
    groups, order = results.groups(task), [variant.name for variant in ablation_variants()]
    first = pd.DataFrame([runs.iloc[0] for runs in groups.values()], index=list(groups))
    known = first[first["variant"].isin(order)].sort_values("variant", key=lambda names: names.map(order.index), kind="stable")
    found, is_base = [], known["variant"] == order[0]
    for base in known.index[is_base]:
        alike = (known[ALIKE] == known.loc[base, ALIKE]).all(axis="columns") & ~is_base
        found.append({label: groups[label] for label in (base, *known.index[alike])})
    return found


def without_effect(results: Results, task: str) -> list[str]:
    """Labels of the ablations on a task whose removal of a part changed not one action in any seed."""
    groups = [list(group.items()) for group in ablation_groups(results, task)]
    return [label for (_, base), *rest in groups for label, own in rest if changed_actions(results, base, own) is False]


def changed_actions(results: Results, base: pd.DataFrame, other: pd.DataFrame) -> bool | None:
    """Whether the actions of training differ between runs with every part and runs without one, for some seed that both
    have; None without a common seed or episode."""
    actions = {run: rows["actions_crc32"].tolist() for run, rows in results.episodes.groupby("run")}
    ours, theirs = ({row.seed: actions.get(row.Index) for row in runs.itertuples()} for runs in (base, other))
    pairs = [(ours[seed], theirs[seed]) for seed in ours if ours[seed] and theirs.get(seed)]
    return any(one != two for one, two in pairs) if pairs else None


def ablation_sections(results: Results, task: str, folder: Path) -> list[Section]:
    """Of the report on a task, with their figures in ``folder``: one for each base, none without ablations."""
    names = {variant.name for variant in ablation_variants()[1:]}
    if names.isdisjoint(results.finished.loc[results.finished["task"] == task, "variant"]):
        return []
    groups, sections = ablation_groups(results, task), []
    for place, found in enumerate(groups, 1):
        base = next(iter(found))
        title = f"What each part is worth: {task}{f', {base}' if len(groups) > 1 else ''}"
        if len(found) > 1:
            picture = f"ablations_{folder_name(task)}{f'_{place}' if place > 1 else ''}.png"
            sections.append(_section(results, task, found, title, folder / picture))
        else:
            sections.append(Section(title, f"Left out: no ablation has as many steps as {base}, and its demonstrations."))
    return sections


def _section(results: Results, task: str, found: dict[str, pd.DataFrame], title: str, picture: Path) -> Section:
    """Of a base and its ablations, which are drawn as well."""
    measure = measure_of(task)
    draw_ablation({name: runs[measure].to_numpy() for name, runs in found.items()}, measure, task, picture)
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
                "without": about[runs["variant"].iloc[0]],
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
    return Section(title, text, pd.DataFrame(rows), picture.name, caption)


def arriving_gradient(results: Results, run: str) -> list[tuple[float, float]]:
    """Of each layer of a run's actor, the last cosine and ratio of norms that it logged; empty where it logged none."""
    if results.diagnostics.empty:
        return []
    own = results.diagnostics[results.diagnostics["run"] == run].dropna(axis="columns", how="all")
    last = {name: float(own[name].dropna().iloc[-1]) for name in map(str, own) if name.startswith("train/actor_")}
    cosines = sorted(name for name in last if name.startswith("train/actor_cosine_"))
    return [(last[name], last[name.replace("cosine", "ratio")]) for name in cosines]
