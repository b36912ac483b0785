"""From names to a table of runs: ids, variants, the file, mistakes."""

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import yaml

from sb3_actpc.cli import main
from sb3_actpc.demonstrations import Demonstrations, shipped_demonstrations
from sb3_actpc.experiments.comparison import find_variant, plan_runs, read_comparison, variant_names
from sb3_actpc.experiments.runs import ALGORITHMS, Run
from sb3_actpc.experiments.runs.algorithms import check_keywords, load_algorithm
from sb3_actpc.experiments.runs.presets import with_changes
from sb3_actpc.experiments.runs.schema import content_id
from tests.experiments.comparison.tasks import small_runs, write_preset

HOPPER = str(shipped_demonstrations("SparseHopper-v5"))


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_preset()


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


def test_runs_of_a_task_with_a_namespace_lie_as_deep_as_others() -> None:
    gym.register("mylab/Pend-v0", "gymnasium.envs.classic_control:PendulumEnv", max_episode_steps=20)
    [run] = plan(envs=["mylab/Pend-v0"])
    assert run.task == "mylab/Pend-v0" and run.folder.parts[:3] == ("out", "mylab_Pend-v0", "actpc")
    del gym.registry["mylab/Pend-v0"]


def test_a_task_with_two_names_has_two_sets_of_demonstrations() -> None:
    few = {"env": "SparseReacher-v5", "task": "few", "settings": {"n_demonstrations": 2}}
    runs = plan(envs=["SparseReacher-v5", few], algos=["actpc"], seeds=1)
    assert [(run.env, run.task, run.settings.get("n_demonstrations")) for run in runs] == [
        ("SparseReacher-v5", "SparseReacher-v5", None),
        ("SparseReacher-v5", "few", 2),
    ]
    with pytest.raises(ValueError, match="'few' is given twice"):
        plan(envs=[few, few], algos=["actpc"], seeds=1)


def test_seeds_that_nothing_was_chosen_on_can_be_asked_for() -> None:
    assert [run.seed for run in plan(seeds=3, first_seed=4)] == [4, 5, 6]
    assert plan(seeds=1, first_seed=2)[0].id == plan(seeds=3)[2].id
    with pytest.raises(ValueError, match="first_seed=-1 must be"):
        plan(first_seed=-1)


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


def test_an_id_follows_the_presets_content_not_its_name() -> None:
    [before] = small_runs(Path("out"))
    Path("renamed.yml").write_bytes(Path("small.yml").read_bytes())
    entry = {"name": "first", "algo": "actpc", "preset": "renamed.yml", "settings": {"gamma": 0.9}}
    assert small_runs(Path("out"), [entry])[0].id == before.id
    write_preset(tau=0.5)
    assert small_runs(Path("out"))[0].id != before.id


def test_a_run_survives_its_trip_to_a_worker() -> None:
    for run in small_runs(Path("out"), seeds=2):
        assert Run.model_validate_json(run.model_dump_json()) == run


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
    assert "4 of 4 runs to do" in of_file
    assert not Path("there").exists()  # a dry run leaves nothing behind


def test_variants_and_tasks_of_a_file_have_settings_of_their_own() -> None:
    runs = plan(
        envs=["SparseReacher-v5", {"env": "SparseHopper-v5", "steps": 40}],
        algos=["actpc", {"base": "no_signals", "name": "slow", "settings": {"gamma": 0.5}, "steps": 20}],
        steps=60,
    )
    assert [run.n_timesteps for run in runs] == [60, 20, 40, 20]
    assert {key: runs[1].settings[key] for key in ("alpha_ep", "gamma")} == {"alpha_ep": 0.0, "gamma": 0.5}


def test_what_an_entry_leaves_empty_is_not_said() -> None:
    """As at the top of a file."""
    [run] = plan(envs=[{"env": "SparseReacher-v5", "eval_freq": None}], algos=[{"algo": "actpc", "steps": None}], steps=500)
    assert (run.n_timesteps, run.eval_freq) == (500, 50)


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


def test_every_named_variant_has_settings_that_its_algorithm_takes() -> None:
    for name in variant_names():
        variant = find_variant(name)
        assert variant.algo in ALGORITHMS
        if variant.algo == "rlpd" and not find_spec("jax"):
            continue  # an extra
        check_keywords(load_algorithm(variant.algo), with_changes({}, variant.settings))


def test_a_variant_on_another_version_of_the_task_stands_beside_the_others() -> None:
    [run] = plan(envs=["SparseHopper-v5"], algos=["her"])
    assert (run.task, run.env) == ("SparseHopper-v5", "GoalHopper-v5")
    [named] = plan(envs=["sb3_actpc.envs:SparseHopper-v5"], algos=["her"])  # with the same demonstrations
    assert named.env == "sb3_actpc.envs:GoalHopper-v5" and named.demonstrations_sha256 == run.demonstrations_sha256


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--envs", "SparseReacher-v5", "--algos", "actpcc"], "did you mean 'actpc'?"),
        (["--envs", "SparseNothing-v0", "--algos", "actpc"], "SparseNothing"),
        (["--envs", "SparseReacher-v5", "--algos", "actpc", "--seeds", "0"], "seeds=0 must be"),
        (["--envs", "SparseReacher-v5", "--algos", "actpc", "--seeds", "-3"], "seeds=-3 must be"),
        (["--envs", "SparseReacher-v5"], "no algorithm to compare"),
        (["--algos", "actpc"], "no task to compare on"),
        (["--envs", "SparseReacher-v5", "--algos", "actpc", "actpc"], "'actpc' is given twice"),
        (["--envs", "SparseReacher-v5", "--algos", "actpc", "--demonstrations", "no.npz"], "no.npz"),
        (
            ["--envs", "SparseReacher-v5", "--algos", "actpc", "--demonstrations", "text.npz"],
            "Reacher-v5: text.npz: expected a dem",
        ),
        (
            ["--envs", "SparseReacher-v5", "--algos", "actpc", "--demonstrations", HOPPER],
            "'SparseReacher-v5' (any version), found",
        ),
        (["task.yml"], f"SparseReacher-v5: {HOPPER}: "),
        (["--envs", "SparseReacher-v5", "--algos", "actpc", "--steps", "0"], "steps='0' must be at least 1"),
        (["--envs", "SparseReacher-v5", "--algos", "actpc", "--engine", "slurm"], "choose one of local, ray"),
        (["--envs", "SparseReacher-v5", "--algos", "actpc", "--workers", "0"], "workers=0 must be at least 1"),
        (["--envs", "SparseReacher-v5", "--algos", "actpc", "--address", "auto"], "add --engine ray"),
        (["nowhere.yml"], "no comparison file at nowhere.yml"),
        (["wrong.yml"], "unknown key 'sedes'"),
        (["list.yml"], "expected a mapping"),
        (["variant.yml"], "unknown key 'colour'"),
        (["name.yml"], "it becomes a folder's"),
        (["twins.yml"], "SparseReacher-v5: 'one' and 'two' have the same settings"),
    ],
)
def test_mistakes_give_one_line_and_begin_nothing(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("wrong.yml").write_text("{envs: [SparseReacher-v5], algos: [actpc], sedes: 3}", encoding="utf-8")
    Path("list.yml").write_text("[1]", encoding="utf-8")
    Path("variant.yml").write_text("{envs: [SparseReacher-v5], algos: [{algo: actpc, colour: red}]}", encoding="utf-8")
    Path("name.yml").write_text("{envs: [SparseReacher-v5], algos: [{algo: actpc, name: ../up}]}", encoding="utf-8")
    task = f"{{env: SparseReacher-v5, demonstrations: {HOPPER}}}"
    Path("task.yml").write_text(f"{{envs: [SparseHopper-v5, {task}], algos: [actpc, td3], steps: 20}}", encoding="utf-8")
    Path("text.npz").write_text("no demonstrations", encoding="utf-8")
    twins = "[{algo: actpc, name: one}, {base: actpc, name: two}]"
    Path("twins.yml").write_text(f"{{envs: [SparseReacher-v5], algos: {twins}}}", encoding="utf-8")
    assert main(["compare", *arguments]) == 2
    errors = capsys.readouterr().err.strip()
    assert message in errors and "\n" not in errors
    assert not list(Path(".").rglob("seed*"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"envs": [{"env": "SparseHopper-v5", "env_kwargs": {"conditon": "forward"}}]}, "no keyword 'conditon' (did you mean"),
        ({"env_kwargs": {"threshold": "high"}}, "SparseReacher-v5: "),
        ({"settings": {"gamma": "high"}}, "SparseReacher-v5, actpc: gamma='high' must be a finite number"),
        ({"settings": {"gamma": 2}}, "gamma=2 must be between 0 and 1"),
        ({"settings": {"learning_rate": "lin_high"}}, "learning_rate='lin_high' must be a number or lin_<number>"),
        ({"algos": [{"algo": "her", "settings": {"q_filter": "no"}}]}, "q_filter='no' must be True or False"),
        ({"first_seed": 2**31 - 1, "seeds": 2}, "the last seed, 2147483648, must be at most 2147483647: give fewer seeds"),
        ({"algo": "td3"}, "algo='td3' cannot be given here, where it counts for nothing: give it in an entry of algos"),
        ({"name": "foo"}, "name='foo' cannot be given here"),
        ({"task_prefix": "Goal"}, "task_prefix='Goal' cannot be given here"),
        ({"env": "Ant-v5"}, "env='Ant-v5' cannot be given here, where it counts for nothing: give it in an entry of envs"),
        ({"envs": [{"env": "SparseReacher-v5", "algo": "td3"}]}, "algo='td3' cannot be given here"),
        ({"algos": [{"base": "actpc", "env": "Ant-v5"}]}, "env='Ant-v5' cannot be given here"),
        ({"algos": [{"base": ["actpc"]}]}, "base=['actpc'] must be a text: the name of the variant"),
        ({"steps": 10, "n_timesteps": 20}, "steps=10 is given under another name too (steps and n_timesteps are one key)"),
    ],
)
def test_no_run_is_planned_that_would_fail_or_not_be_what_was_said(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        plan(**given)


def test_given_demonstrations_are_read_once_for_all_algorithms_of_a_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the goal task too, whose version of them fits; those of the package are right."""
    read: list[str] = []
    original = Demonstrations.load
    monkeypatch.setattr(Demonstrations, "load", lambda path: read.append(str(path)) or original(path))
    plan(envs=["SparseHopper-v5"], algos=["actpc", "no_signals", "td3", "her"], demonstrations=HOPPER, seeds=2)
    assert read == [HOPPER, HOPPER]
    plan(envs=["SparseHopper-v5"])
    assert len(read) == 2
