"""A part whose removal changes not one action is no part: every ablation of a few steps against the base."""

from pathlib import Path

import pandas as pd
import pytest

from sb3_actpc.experiments.comparison import ablation_variants, plan_runs, read_comparison
from sb3_actpc.experiments.comparison.execution import FINISHED, execute_run
from sb3_actpc.experiments.report.ablations import arriving_gradient, changed_actions, without_effect
from sb3_actpc.experiments.report.results import Results, load_results
from sb3_actpc.experiments.runs import Run
from tests.experiments.comparison.tasks import TASK, write_demonstrations, write_preset

BASE, *ABLATIONS = ablation_variants()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ablations")


def run_variants(folder: Path, *variants: Run) -> Results:
    """Of each a run of 56 steps: seven episodes, the first of them random, and an update after each later step."""
    # every update reaches the actor that acts
    at_once = {"actor_warm_start": 5, "critic_warmup": 0, "policy_delay": 1}
    policy = {"net_arch": [8], "habit": False}
    write_preset(folder / "small.yml", demonstration_fraction=0.25, n_timesteps=56, policy_kwargs=policy, **at_once)
    write_demonstrations(folder / "demonstrations.npz")
    entries = [{"base": variant.name, "preset": str(folder / "small.yml")} for variant in variants]
    task = {"env": TASK, "demonstrations": str(folder / "demonstrations.npz")}
    given = {"envs": [task], "algos": entries, "seeds": 1, "eval_freq": 56, "eval_episodes": 1, "checkpoint_freq": 0}
    for run in plan_runs(read_comparison(given), folder):
        assert execute_run(run, lambda line: None, lambda steps: None).status == FINISHED
    return load_results(folder)


@pytest.mark.parametrize("variant", ABLATIONS, ids=[variant.name for variant in ABLATIONS])
def test_the_removal_of_a_part_changes_an_action(variant: Run, folder: Path) -> None:
    results = run_variants(folder, BASE, variant)
    [task] = results.runs["task"].unique()
    groups = results.groups(task)
    changed = changed_actions(results, groups[BASE.name], groups[variant.name])
    assert changed is True, f"{variant.name} acts as {BASE.name} does: the part does nothing"
    assert variant.name not in without_effect(results, task)
    layers = arriving_gradient(results, groups[BASE.name].index[0])
    assert len(layers) == 2 and all(-1.001 <= cosine <= 1.001 and ratio > 0 for cosine, ratio in layers)


def test_a_variant_that_changes_nothing_is_found(folder: Path) -> None:
    kept = run_variants(folder, BASE)
    base = kept.runs.index[kept.runs["variant"] == BASE.name][0]
    idle = kept.runs.loc[[base]].assign(variant=ABLATIONS[0].name, label=ABLATIONS[0].name).rename({base: "idle"})
    episodes = kept.episodes[kept.episodes["run"] == base]
    results = Results(
        pd.concat([kept.runs.loc[[base]], idle]),
        kept.evaluations,
        pd.concat([episodes, episodes.assign(run="idle")]),
        kept.diagnostics,
    )
    assert without_effect(results, results.runs["task"].iloc[0]) == [ABLATIONS[0].name]
