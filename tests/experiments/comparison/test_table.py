"""From names to a table of runs: ids, variants, the file, mistakes."""

import re
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import yaml

from sb3_actpc.cli import main
from sb3_actpc.demonstrations import shipped_demonstrations
from sb3_actpc.experiments.comparison import plan_runs, read_comparison, variant_names
from sb3_actpc.experiments.runs import ALGORITHMS, Run
from sb3_actpc.experiments.runs.schema import content_id

HOPPER = str(shipped_demonstrations("SparseHopper-v5"))


def plan(**given: Any) -> list[Run]:
    choices = {"envs": ["SparseReacher-v5"], "algos": ["actpc"], "seeds": 1, **given}
    return plan_runs(read_comparison(choices), Path("out"))


def test_every_algorithm_meets_every_task_with_every_seed_and_the_first_seeds_come_first() -> None:
    runs = plan(envs=["SparseReacher-v5", "SparseHopper-v5"], algos=["actpc", "no_signals"], seeds=2)
    assert [(run.task, run.name, run.seed) for run in runs[:4]] == [
        ("SparseReacher-v5", "actpc", 0),
        ("SparseReacher-v5", "no_signals", 0),
        ("SparseHopper-v5", "actpc", 0),
        ("SparseHopper-v5", "no_signals", 0),
    ]
    assert len(runs) == 8 and len({run.id for run in runs}) == 8 and len({run.folder for run in runs}) == 8
    later = plan(seeds=3, first_seed=4)
    assert [run.seed for run in later] == [4, 5, 6] and plan(seeds=1, first_seed=5)[0].id == later[1].id


def test_an_id_follows_the_content_of_a_run_and_nothing_else() -> None:
    [run] = plan(steps=500)
    assert plan(steps=500, threads=2, checkpoint_freq=7)[0].id == run.id  # how it is run is not what is run
    unsaid = run.model_dump(exclude={"keep", "target_return"})  # by a version that did not count them
    assert plan(steps=500, keep="last")[0].id == run.id == content_id(unsaid, run.seed)
    others = [
        plan(steps=501),
        plan(steps=500, demonstrations="none"),
        plan(steps=500, eval_episodes=3),
        plan(steps=500, target_return=100.0),
        plan(steps=500, keep="best"),
        plan(steps=500, algos=["no_signals"]),
        plan(steps=500, envs=[{"env": "SparseReacher-v5", "env_kwargs": {"threshold": 0.1}}]),
        plan(steps=500, seeds=2)[1:],
    ]
    assert len({run.id, *(other[0].id for other in others)}) == 1 + len(others)


def test_variants_with_other_environments_warn_until_the_task_says_which() -> None:
    """The preset of the paper's agent rewards forward motion on this task, the default distance."""
    algos = ["actpc", "actpc_faithful"]
    with pytest.warns(UserWarning, match=r"SparseHopper-v5: .*actpc \{\}, actpc_faithful \{'condition': 'forward'"):
        plan(envs=["SparseHopper-v5"], algos=algos)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        equal = plan(
            envs=[{"env": "SparseHopper-v5", "env_kwargs": {"condition": "displacement", "threshold": None}}], algos=algos
        )
    assert equal[0].env_kwargs == equal[1].env_kwargs


def test_a_file_says_the_same_as_the_options(capsys: pytest.CaptureFixture[str]) -> None:
    given = {"envs": ["SparseReacher-v5"], "algos": ["actpc", "no_signals"], "seeds": 2, "first_seed": 3, "steps": 300}
    given["output"] = "there"
    Path("c.yml").write_text(yaml.safe_dump(given), encoding="utf-8")
    assert main(["compare", "c.yml", "--dry-run"]) == 0
    of_file = capsys.readouterr().out
    options = ["--envs", "SparseReacher-v5", "--algos", "actpc", "no_signals", "--seeds", "2", "--steps", "300"]
    options += ["--first-seed", "3"]
    assert main(["compare", *options, "--output", "there", "--dry-run"]) == 0
    assert capsys.readouterr().out == of_file
    assert of_file.count("SparseReacher-v5") == 4
    assert not Path("there").exists()  # a dry run leaves nothing behind


def test_variants_and_tasks_of_a_file_have_settings_and_names_of_their_own() -> None:
    runs = plan(
        envs=["SparseReacher-v5", {"env": "SparseHopper-v5", "steps": 40}],
        algos=["actpc", {"base": "no_signals", "name": "slow", "settings": {"gamma": 0.5}, "steps": 20}],
        steps=60,
    )
    assert [run.n_timesteps for run in runs] == [60, 20, 40, 20]
    assert (runs[1].settings["reward_weights"]["epistemic"], runs[1].settings["gamma"]) == (0.0, 0.5)
    few = {"env": "SparseReacher-v5", "task": "few", "settings": {"n_demonstrations": 2}}
    named = plan(envs=["SparseReacher-v5", few])
    assert [(run.task, run.settings.get("n_demonstrations")) for run in named] == [("SparseReacher-v5", None), ("few", 2)]


def test_what_a_preset_says_can_be_left_out() -> None:
    """In all runs, those of a task, and those of a variant, which otherwise would be another's twin."""
    plain = {"name": "plain", "algo": "ppo", "normalize": False}
    given: dict[str, Any] = {"envs": ["Pendulum-v1"], "algos": ["ppo", plain], "demonstrations": "none"}
    assert [run.normalize for run in plan(**given)] == [{"gamma": 0.99}, None]
    assert [run.normalize for run in plan(**{**given, "algos": ["ppo"], "normalize": False})] == [None]
    quiet = {"env": "SparseHopper-v5", "noise_type": None}
    assert [run.noise_type for run in plan(envs=[quiet], algos=["td3"])] == [None]
    assert [run.noise_type for run in plan(algos=["td3"], noise_type=None)] == [None]


def test_an_algorithm_can_be_chosen_by_the_name_that_a_file_gives_it(capsys: pytest.CaptureFixture[str]) -> None:
    own = {"base": "no_signals", "name": "slow", "steps": 20}
    unnamed = {"base": "iterative", "steps": 30}  # goes by the name of its base
    content = {"envs": ["SparseReacher-v5"], "algos": [own, unnamed], "n_timesteps": 70}
    Path("c.yml").write_text(yaml.safe_dump(content), encoding="utf-8")
    names = ["slow", "actpc", "iterative"]
    assert main(["compare", "c.yml", "--algos", *names, "--seeds", "1", "--steps", "60", "--dry-run"]) == 0
    rows = [line.split()[2:5:2] for line in capsys.readouterr().out.splitlines()[1:4]]
    assert rows == [["slow", "20"], ["actpc", "60"], ["iterative", "30"]]
    assert main(["compare", "c.yml", "--algos", "slwo", "--dry-run"]) == 2
    assert "(did you mean 'slow'?)" in capsys.readouterr().err
    Path("c.yml").write_text("{envs: [SparseReacher-v5], algos: }", encoding="utf-8")
    assert main(["compare", "c.yml", "--algos", "actpc", "--dry-run"]) == 0


def test_a_variant_on_another_version_of_the_task_stands_beside_the_others() -> None:
    [run] = plan(envs=["SparseHopper-v5"], algos=["her"])
    assert (run.task, run.env) == ("SparseHopper-v5", "GoalHopper-v5")
    [named] = plan(envs=["sb3_actpc.envs:SparseHopper-v5"], algos=["her"])  # with the same demonstrations
    assert named.env == "sb3_actpc.envs:GoalHopper-v5" and named.demonstrations_sha256 == run.demonstrations_sha256


def test_every_named_variant_can_be_planned() -> None:
    names = [name for name in variant_names() if name not in ALGORITHMS]
    assert {"no_guidance", "actpc_paper"} <= set(names)
    assert [run.name for run in plan(algos=names)] == names


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"algos": ["actpcc"]}, "did you mean 'actpc'?"),
        ({"envs": ["SparseNothing-v0"]}, "SparseNothing"),
        ({"seeds": 0}, "seeds=0 must be"),
        ({"algos": []}, "algos must be a list of at least one"),
        ({"algos": ["actpc", "actpc"]}, "'actpc' is given twice"),
        ({"demonstrations": "no.npz"}, "no.npz"),
        ({"demonstrations": "text.npz"}, "text.npz: expected a dem"),
        ({"demonstrations": HOPPER}, "'SparseReacher-v5' (any version), found"),
        ({"sedes": 3}, "unknown key 'sedes' (=3) here (did you mean 'seeds'?)"),
        ({"algos": [{"algo": "actpc", "colour": "red"}]}, "unknown key 'colour'"),
        ({"algos": [{"algo": "actpc", "name": "../up"}]}, "name='../up' must match pattern"),
        ({"envs": [{"env": "SparseHopper-v5", "env_kwargs": {"conditon": "forward"}}]}, "'conditon'"),
        ({"env_kwargs": {"threshold": "high"}}, "SparseReacher-v5, actpc: "),
        ({"settings": {"gamma": "high"}}, "SparseReacher-v5, actpc: gamma='high' must be a finite number"),
        ({"settings": {"learning_rate": "lin_high"}}, "learning_rate='lin_high' must be a number or lin_<number>"),
        ({"first_seed": 2**31 - 1, "seeds": 2}, "the last seed, 2147483648, must be at most 2147483647"),
        ({"algo": "td3"}, "unknown key 'algo' (='td3') here"),
        ({"seed": 3}, "unknown key 'seed' (=3) here"),
        ({"envs": [{"env": "SparseReacher-v5", "algo": "td3"}]}, "unknown key 'algo' (='td3') here"),
        ({"algos": [{"base": "actpc", "env": "Ant-v5"}]}, "unknown key 'env' (='Ant-v5') here"),
        ({"algos": [{"settings": {}}]}, "expected the name of an algorithm, or a mapping with algo or base"),
    ],
)
def test_no_run_is_planned_that_would_fail_or_not_be_what_was_said(given: dict[str, Any], message: str) -> None:
    Path("text.npz").write_text("no demonstrations", encoding="utf-8")
    with pytest.raises((ValueError, FileNotFoundError, gym.error.Error), match=re.escape(message)):
        plan(**given)
