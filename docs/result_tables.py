"""Tables and figures of docs/results.md and docs/results_details.md, from the evaluations in docs/results_data:
``python docs/result_tables.py``.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_actpc.experiments.report.results import Results, load_results
from sb3_actpc.experiments.report.statistics import probability_of_improvement
from sb3_actpc.experiments.report.tables import draw_curves, markdown

FOLDER = Path(__file__).with_name("results_data")
# name of a policy -> its variant and the column of its return
POLICIES = {
    "ActPC, moving average": ("actpc", "actor_return"),
    "ActPC, deployed policy": ("actpc", "return"),
    "RLPD": ("rlpd", "return"),
}
SHORT = (0, 2_500, 5_000, 7_500, 10_000)
LONG = (0, 10_000, 20_000, 30_000, 40_000, 50_000)
# folder -> task -> the steps of its table
STEPS: dict[str, dict[str, Sequence[int]]] = {
    "steps_10000": {
        "Hopper-suboptimal": SHORT,
        "Walker2d-suboptimal": SHORT,
        "Swimmer-suboptimal": SHORT,
        "Walker2d": SHORT,
        "Hopper-five": SHORT,
        "Walker2d-five": SHORT,
        "SparseReacher-v5": (0, 2_000, 4_000, 6_000, 8_000),
    },
    "steps_50000": {"Hopper-suboptimal": LONG, "Walker2d-suboptimal": LONG},
}
NAMES = {
    "Hopper-suboptimal": "Hopper",
    "Walker2d-suboptimal": "Walker2d",
    "Swimmer-suboptimal": "Swimmer",
    "Walker2d": "Walker2d, shipped demonstrations",
    "Hopper-five": "Hopper, five demonstrations",
    "Walker2d-five": "Walker2d, five demonstrations",
    "SparseReacher-v5": "Reacher, shipped demonstrations",
}
# baselines at their present settings, same demonstrations and seeds: name -> variant and the column of its return
COMPARED = {
    **POLICIES,
    "IBRL": ("ibrl", "return"),
    "TD3+BC": ("td3_bc", "return"),
    "DDPG-Demo": ("ddpg_demo", "return"),
    "`actpc_faithful`": ("actpc_faithful", "return"),
    "plain BC": ("bc", "return"),
    "plain BC, no early stopping": ("bc_all", "return"),
}
MAIN_BASELINES = {"RLPD": "rlpd", "plain BC": "bc"}
OFFLINE = ("bc", "bc_all", "bc_rnn")  # variants without RL
COMPARED_TASKS = ("Hopper-suboptimal", "Walker2d-suboptimal")
# further baselines on the demonstrations of steps_10000, in a folder of their own, with fewer seeds: name -> variant
OTHERS = {
    "ActPC without the gate": "no_gate",
    "imitation only": "imitation_only",
    "RLPD, ten critics, ten updates per step": "rlpd_utd10",
    "IBRL": "ibrl",
    "TD3+BC": "td3_bc",
    "LOGO": "logo",
    "BC-RNN": "bc_rnn",
}
# dense rewards without demonstrations: name of a row -> variant
DENSE = {"ActPC, `n_steps=3`": "actpc", "TD3": "TD3", "SAC": "SAC"}
DENSE_TASKS = ("HalfCheetah-v5", "Hopper-v5")
FETCH = {**POLICIES, "RLPD with hindsight": ("rlpd_her", "success"), "HER": ("her", "success")}  # success instead of returns
FETCH_STEPS = (0, 5_000, 10_000, 15_000, 20_000)
# plain BC with early stopping, and with all demonstrations in batches of 256: task -> the measure and its digits
BC_TASKS = {
    "Walker2d": ("return", 0),
    "HalfCheetah-suboptimal": ("return", 0),
    "Swimmer-suboptimal": ("return", 0),
    "SparseReacher-v5": ("return", 0),
    "door": ("success", 2),
}
DOOR = {
    "ActPC, moving average": ("critic", "actor_return"),
    "ActPC, deployed policy": ("critic", "return"),
    "no critic term, moving average": ("imitation", "actor_return"),
    "no critic term, deployed policy": ("imitation", "return"),
    "RLPD": ("rlpd", "return"),
}
# the gate with two exploration episodes and with one: task -> the columns of moving average and deployed policy, and digits
GATES = {"two": "actpc", "one": "actpc_one"}
GATE_TASKS = {
    "SparseReacher-v5": (("actor_return", "return"), 0),
    "Walker2d": (("actor_return", "return"), 0),
    "HalfCheetah-suboptimal": (("actor_return", "return"), 0),
    "Can-10": (("actor_success", "success"), 2),
}
# a clamped output of the actor: task -> its name, and the folders of the default output, and of RLPD and BC
CLAMPED = {
    "Hopper-303": ("Hopper, suboptimal (selection)", "clamped_output", "clamped_output"),
    "Walker2d-303": ("Walker2d, suboptimal (selection)", "clamped_output", "clamped_output"),
    "HalfCheetah-suboptimal": ("HalfCheetah, suboptimal", "checked_baselines", "checked_baselines"),
    "Walker2d": ("Walker2d, shipped", "gates", "steps_10000"),
}
# no settings were chosen on them
REPORTED = ("Hopper-suboptimal", "Walker2d-suboptimal", "Swimmer-suboptimal", "Walker2d", "Hopper-five", "Walker2d-five")


def clamped_table() -> list[str]:
    """Lines of the table of both outputs of the actor, with the same seeds: after BC, and after 10,000 steps."""
    clamped, rows = load_results(FOLDER / "clamped_output"), []
    for task, (name, folder, of_others) in CLAMPED.items():
        default, others = load_results(FOLDER / folder), load_results(FOLDER / of_others)
        runs = {"clamp": clamped.groups(task)["actpc_clamp"], "tanh": default.groups(task)["actpc"]}
        seeds = set(runs["clamp"]["seed"])
        assert seeds == set(runs["tanh"]["seed"]), f"{task}: other seeds"
        for label, source in (("tanh", default), ("clamp", clamped)):
            measures = (("return", 0), ("actor_return", 10_000), ("return", 10_000))
            rows.append([name, f"ActPC, {label}", *(spread(source.at_step(runs[label], *measure)) for measure in measures)])
        groups = {variant: group[group["seed"].isin(seeds)] for variant, group in others.groups(task).items()}
        if "rlpd" in groups:
            rows.append([name, "RLPD", "", spread(others.at_step(groups["rlpd"], "return", 10_000)), ""])
        rows.append([name, "plain BC", spread(groups["bc"]["return"]), "", ""])
    return lines_of(["demonstrations", "agent", "BC", "10,000 steps", "10,000 steps, deployed policy"], rows)


def spread(values: pd.Series) -> str:
    """The mean, with the smallest and the largest in brackets; of a single value that one."""
    if len(values) == 1:
        return f"{values.iloc[0]:.0f}"
    return f"{values.mean():.0f} ({values.min():.0f} to {values.max():.0f})"


def lines_of(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table in Markdown."""
    return markdown(pd.DataFrame(rows, columns=columns)).splitlines()


def cells(results: Results, runs: pd.DataFrame, measure: str, steps: Sequence[int]) -> list[str]:
    """What runs of a variant reached at the steps, over seeds; without RL a single evaluation stands for all steps."""
    if runs["variant"].isin(OFFLINE).all():
        return [spread(runs[measure]), *[""] * (len(steps) - 1)]
    return [spread(results.at_step(runs, measure, step)) for step in steps]


def table(results: Results, task: str, steps: Sequence[int]) -> list[str]:
    """Lines of the table of a task: returns at the steps, over seeds; BC has a single evaluation."""
    groups = results.groups(task)
    rows = [
        [policy, *cells(results, groups[variant], measure, steps)]
        for policy, (variant, measure) in {**POLICIES, "plain BC": ("bc", "return")}.items()
    ]
    return lines_of(["steps", *(f"{step:,}" for step in steps)], rows)


def compared_table(results: Results, task: str) -> list[str]:
    """Lines of the table of all baselines on a task: returns at the steps, over seeds; BC has a single evaluation."""
    rows = []
    for policy, (variant, measure) in COMPARED.items():
        runs = runs_of(results, task, variant)
        rows.append([policy, str(len(runs)), *cells(results, runs, measure, SHORT)])
    return lines_of(["steps", "seeds", *(f"{step:,}" for step in SHORT)], rows)


def others_table(others: Results, short: Results, task: str) -> list[str]:
    """Lines of the table of the other baselines, and of ActPC, RLPD and BC with the same seeds."""
    groups = others.groups(task)
    steps = STEPS["steps_10000"][task]
    seeds = {seed for runs in groups.values() for seed in runs["seed"]}
    rows = []
    same = {**POLICIES, "plain BC": ("bc", "return")}
    for policy, (variant, measure) in same.items():
        runs = short.groups(task)[variant]
        runs = runs[runs["seed"].isin(seeds)]
        rows.append([policy, str(len(runs)), *cells(short, runs, measure, steps)])
    for policy, variant in OTHERS.items():
        if variant in groups:
            rows.insert(-1, [policy, str(len(groups[variant])), *cells(others, groups[variant], "return", steps)])
    return lines_of(["steps", "seeds", *(f"{step:,}" for step in steps)], rows)


def listed(values: pd.Series, digits: int) -> str:
    """The value of every seed that has got so far."""
    return ", ".join(f"{value:.{digits}f}" for value in values.dropna())


def runs_of(results: Results, task: str, variant: str) -> pd.DataFrame:
    """Finished runs of a variant, one for each seed, whatever their steps and defaults: their learner is the same."""
    runs = results.finished
    return runs[(runs["task"] == task) & (runs["variant"] == variant)].sort_values("seed", kind="stable")


def success_table(results: Results, task: str, policies: Mapping[str, tuple[str, str]], steps: Sequence[int]) -> list[str]:
    """Lines of the table of a task that succeeds or fails: success of every seed at the steps."""
    rows = []
    for policy, (variant, measure) in policies.items():
        runs, column = runs_of(results, task, variant), measure.replace("return", "success")
        rows.append([policy, *(listed(results.at_step(runs, column, step), 2) for step in steps)])
    rows.append(["plain BC", listed(runs_of(results, task, "bc")["success"], 2), *[""] * (len(steps) - 1)])
    return lines_of(["steps", *(f"{step:,}" for step in steps)], rows)


def gate_table(gates: Results, checked: Results) -> list[str]:
    """Lines of the table of both gates: the policy after BC, and average and deployed policy at the end, every seed."""
    rows = []
    for task, ((average, deployed), digits) in GATE_TASKS.items():
        for episodes, variant in GATES.items():
            results = gates if len(runs_of(gates, task, variant)) else checked
            runs = runs_of(results, task, variant)
            if runs.empty:
                continue
            last = int(runs["steps"].iloc[0])
            at = ((deployed, 0), (average, last), (deployed, last))
            cells = [listed(results.at_step(runs, column, step), digits) for column, step in at]
            rows.append([task, episodes, ", ".join(str(seed) for seed in runs["seed"]), f"{last:,}", *cells])
    return lines_of(["task", "exploration episodes", "seeds", "steps", "after BC", "moving average", "deployed policy"], rows)


def bc_table(checked: Results, folders: Sequence[Results]) -> list[str]:
    """Lines of the table of plain BC with two settings, every seed; a task is in the first of the results that has it."""
    rows = []
    for task, (measure, digits) in BC_TASKS.items():
        stopped = next(runs for runs in (runs_of(one, task, "bc") for one in (checked, *folders)) if len(runs))
        stopped = stopped[stopped["seed"] <= 422]
        whole = runs_of(checked, task, "bc_256")
        rows.append([task, listed(stopped[measure], digits), listed(whole[measure], digits)])
    return lines_of(["demonstrations", "early stopping (`bc.yml`)", "batches of 256, no early stopping"], rows)


def entropy_table(checked: Results, short: Results) -> list[str]:
    """Lines of the table of RLPD with two target entropies: returns of every seed at quarters of its steps."""
    rows = []
    for task in ("Walker2d", "SparseReacher-v5"):
        half, steps = runs_of(checked, task, "rlpd_half"), STEPS["steps_10000"][task]
        same = runs_of(short, task, "rlpd")
        same = same[same["seed"].isin(half["seed"])]
        for name, results, runs in (("-A", short, same), ("-A / 2", checked, half)):
            rows.append([task, name, *(listed(results.at_step(runs, "return", step), 0) for step in steps[1:])])
    return lines_of(["task", "target entropy", "a quarter of the steps", "half", "three quarters", "all"], rows)


def dense_table(results: Results, task: str) -> list[str]:
    """Lines of the table of a task with dense rewards: returns at the steps, over seeds."""
    steps = (5_000, *LONG[1:])
    rows = []
    for name, variant in DENSE.items():
        runs = runs_of(results, task, variant)
        rows.append([name, str(len(runs)), *(spread(results.at_step(runs, "return", step)) for step in steps)])
    return lines_of(["steps", "seeds", *(f"{step:,}" for step in steps)], rows)


def many_updates_table(results: Results) -> list[str]:
    """Lines of the table of SAC with ActPC's updates, without demonstrations: returns of every seed at the steps."""
    steps = FETCH_STEPS[1:]
    rows = [
        [f"`{task}`", *(listed(results.at_step(results.groups(task)["SAC4"], "return", step), 0) for step in steps)]
        for task in DENSE_TASKS
    ]
    return lines_of(["steps", *(f"{step:,}" for step in steps)], rows)


def improvement_table(
    reported: Sequence[tuple[Results, str]], steps: Sequence[int], baselines: Mapping[str, str] = MAIN_BASELINES
) -> list[str]:
    """Lines of the table of probabilities that ActPC has a higher return than the baselines, over tasks, each with the results
    that have it; with 95 % intervals."""

    def returns(variant: str, measure: str, step: int) -> list[np.ndarray]:
        groups = [(results, runs_of(results, task, variant)) for results, task in reported]
        if variant in OFFLINE:
            return [runs[measure].to_numpy() for _, runs in groups]
        return [results.at_step(runs, measure, step).to_numpy() for results, runs in groups]

    def cell(policy: str, variant: str, step: int) -> str:
        value, low, high = probability_of_improvement(returns(*POLICIES[policy], step), returns(variant, "return", step))
        return f"{value:.2f} ({low:.2f} to {high:.2f})"

    rows = [
        [f"{policy.removeprefix('ActPC, ')}, over {name}", *(cell(policy, variant, step) for step in steps)]
        for name, variant in baselines.items()
        for policy in list(POLICIES)[:2]
    ]
    return lines_of(["ActPC after", *(f"{step:,}" for step in steps)], rows)


def first_times(results: Results, tasks: Iterable[str]) -> list[str]:
    """Lines of a table: environment steps after which a policy first has 90 % of the best return that any of them reached on
    the task, and its share of the time in which RLPD has trained until then. Medians over seeds; one that never does counts as
    infinity."""
    table_rows = []
    for task in tasks:
        groups = results.groups(task)
        curves = {}
        for policy, (variant, measure) in POLICIES.items():
            own = results.curves[results.curves["run"].isin(groups[variant].index)]
            curves[policy] = own.assign(value=own[measure], time=own["seconds"] - own["evaluation_seconds"])
        threshold = 0.9 * max(rows["value"].max() for rows in curves.values())
        medians = {}
        for policy, rows in curves.items():
            first = rows[rows["value"] >= threshold].groupby("run")[["timesteps", "time"]].min()
            runs = groups[POLICIES[policy][0]].index
            medians[policy] = first.astype(float).reindex(runs, fill_value=np.inf).median()
        cells = []
        for steps, seconds in medians.values():
            cell = f"{steps:,.0f}" if np.isfinite(steps) else "-"
            if np.isfinite(seconds) and np.isfinite(medians["RLPD"]["time"]):
                cell += f" ({seconds / medians['RLPD']['time']:.1f})"
            cells.append(cell)
        table_rows.append([f"{NAMES[task]}: {threshold:.0f}", *cells])
    return lines_of(["90 % of the best return", *POLICIES], table_rows)


def steadiness(results: Results, tasks: Iterable[str], first: int, threshold: float) -> list[str]:
    """Lines of a table: how many evaluations of all seeds from a step on have a return below the threshold, and the lowest."""
    table_rows = []
    for task in tasks:
        cells = []
        for variant, measure in POLICIES.values():
            runs = results.groups(task)[variant].index
            rows = results.curves[results.curves["run"].isin(runs) & (results.curves["timesteps"] >= first)]
            returns = rows[measure]
            cells.append(f"{(returns < threshold).sum()} of {len(returns)} (lowest {returns.min():.0f})")
        table_rows.append([f"{NAMES[task]}: below {threshold:.0f}", *cells])
    return lines_of([f"from {first:,} steps on", *POLICIES], table_rows)


def summary(short: Results, long: Results) -> list[str]:
    """Lines of README's table: every task at its last step."""
    rows = []
    for results, tasks in ((short, STEPS["steps_10000"]), (long, STEPS["steps_50000"])):
        for task, steps in tasks.items():
            groups = results.groups(task)
            policies = {
                name: spread(results.at_step(groups[variant], column, steps[-1]))
                for name, (variant, column) in POLICIES.items()
            }
            cells = [f"{steps[-1]:,}", spread(short.groups(task)["bc"]["return"]), policies.pop("RLPD"), *policies.values()]
            rows.append([NAMES[task], *cells])
    return lines_of(["task", "steps", "plain BC", "RLPD", *list(POLICIES)[:2]], rows)


def tables() -> dict[str, list[str]]:
    """What it shows -> the lines of every table of the page."""
    found = {}
    checked = load_results(FOLDER / "checked_baselines")
    for folder, tasks in STEPS.items():
        results = load_results(FOLDER / folder)
        for task, steps in tasks.items():
            found[f"{folder}: {task}"] = table(results, task, steps)
        found[f"{folder}: 90 % of the best return"] = first_times(results, tasks)
        reported = [(results, task) for task in REPORTED if task in tasks]
        if folder == "steps_10000":
            reported.append((checked, "HalfCheetah-suboptimal"))
        steps = SHORT if folder == "steps_10000" else LONG
        found[f"{folder}: probability of improvement"] = improvement_table(reported, steps[1:])
    compared = load_results(FOLDER / "compared_10000")
    for task in COMPARED_TASKS:
        found[f"compared_10000: {task}"] = compared_table(compared, task)
    baselines = {name: variant for name, (variant, _) in COMPARED.items() if variant != "actpc"}
    both = [(compared, task) for task in COMPARED_TASKS]
    found["compared_10000: probability of improvement"] = improvement_table(both, SHORT[1:], baselines)
    others, short = load_results(FOLDER / "baselines_10000"), load_results(FOLDER / "steps_10000")
    for task in others.finished["task"].unique():
        found[f"baselines_10000: {task}"] = others_table(others, short, task)
    found["checked_baselines: HalfCheetah"] = table(checked, "HalfCheetah-suboptimal", SHORT)
    found["checked_baselines: BC"] = bc_table(checked, (short, load_results(FOLDER / "door_50000")))
    found["checked_baselines: entropy"] = entropy_table(checked, short)
    found["clamped_output"] = clamped_table()
    dense = load_results(FOLDER / "dense_50000")
    for task in DENSE_TASKS:
        found[f"dense_50000: {task}"] = dense_table(dense, task)
    found["dense_20000"] = many_updates_table(load_results(FOLDER / "dense_20000"))
    fetch = load_results(FOLDER / "fetch_20000")
    for task in ("FetchPickAndPlace-v4", "FetchPush-v4"):
        found[f"fetch_20000: {task}"] = success_table(fetch, task, FETCH, FETCH_STEPS)
    found["door_50000"] = success_table(load_results(FOLDER / "door_50000"), "door", DOOR, LONG)
    found["can_40000"] = success_table(load_results(FOLDER / "can_40000"), "Can-10", POLICIES, LONG[:-1])
    found["forward_10000"] = table(load_results(FOLDER / "forward_10000"), "HalfCheetah-forward", SHORT)
    found["gates"] = gate_table(load_results(FOLDER / "gates"), checked)
    long_runs = load_results(FOLDER / "steps_50000")
    found["steps_50000: steadiness"] = steadiness(long_runs, STEPS["steps_50000"], 15_000, 700)
    found["summary"] = summary(*(load_results(FOLDER / folder) for folder in STEPS))
    return found


if __name__ == "__main__":
    for title, lines in tables().items():
        print(f"{title}\n\n" + "\n".join(lines) + "\n")
    long_runs = load_results(FOLDER / "steps_50000")
    for task in STEPS["steps_50000"]:
        draw_curves(long_runs, task, FOLDER.with_name("_static") / f"{task}.png")
