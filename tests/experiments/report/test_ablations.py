"""A part whose removal changes not one action is no part: every ablation of a few steps against the base."""

from pathlib import Path

import pytest

from sb3_actpc.experiments.comparison import Variant, ablation_variants, plan_runs, read_comparison
from sb3_actpc.experiments.comparison.execution import FINISHED, execute_run
from sb3_actpc.experiments.report.ablations import arriving_gradient, changed_actions, without_effect
from sb3_actpc.experiments.report.results import Group, group_runs, load_runs
from tests.experiments.comparison.tasks import TASK, write_demonstrations, write_preset

BASE, *ABLATIONS = ablation_variants()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ablations")


def runs_of(variant: Variant, folder: Path) -> Group:
    """A run of 56 steps: seven episodes, the first of them random, and an update after each later step."""
    write_preset(folder / "small.yml", demonstration_fraction=0.25, n_timesteps=56)
    write_demonstrations(folder / "demonstrations.npz")
    entry = {"base": variant.name, "preset": str(folder / "small.yml")}
    task = {"env": TASK, "demonstrations": str(folder / "demonstrations.npz")}
    given = {"envs": [task], "algos": [entry], "seeds": 1, "eval_freq": 56, "eval_episodes": 1, "checkpoint_freq": 0}
    [run] = plan_runs(read_comparison(given), folder)
    assert execute_run(run, lambda line: None, lambda steps: None).status == FINISHED
    [group] = [group for group in group_runs(load_runs(folder)) if group.variant == variant.name]
    return group


@pytest.mark.parametrize("variant", ABLATIONS, ids=[variant.name for variant in ABLATIONS])
def test_the_removal_of_a_part_changes_an_action(variant: Variant, folder: Path) -> None:
    base = runs_of(BASE, folder)
    ablated = runs_of(variant, folder)
    assert changed_actions(base, ablated) is True, f"{variant.name} acts as {BASE.name} does: the part does nothing"
    assert variant.name not in without_effect([base, ablated])
    layers = arriving_gradient(base.runs[0])
    assert len(layers) == 2 and all(-1.001 <= cosine <= 1.001 and ratio > 0 for cosine, ratio in layers)


def test_a_variant_that_changes_nothing_is_found(folder: Path) -> None:
    base = runs_of(BASE, folder)
    idle = Group(base.task, ABLATIONS[0].name, base.runs)
    assert changed_actions(base, idle) is False
    assert without_effect([base, idle]) == [ABLATIONS[0].name]
