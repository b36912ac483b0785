"""Methods of other packages, in processes of their own: what goes through the pipes, and what comes of failures."""

import gc
import io
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_actpc.baselines import BCQ, CQL
from sb3_actpc.baselines.offline import installation
from sb3_actpc.baselines.offline.installation import environment_python, install
from sb3_actpc.baselines.offline.process import ServerFailed, ServerProcess
from sb3_actpc.baselines.offline.served import SERVER, ServedAlgorithm
from sb3_actpc.baselines.offline.servers.frames import pack, unpack
from sb3_actpc.cli import main
from sb3_actpc.experiments.runs import load_preset, play_episodes
from tests.recordings import record

# Its action is the number of its gradient steps in hundredths.
FAKE_SERVER = """
import os, sys, time, types
sys.path.insert(0, {folder!r})
import numpy as np
from frames import serve

n, kwargs = 0, {{}}

def build(values, arrays):
    global kwargs
    kwargs = values["method_kwargs"]
    print("libraries print what they like", flush=True)
    if "refuse" in kwargs:
        raise ValueError("net_arch must be a list")
    return {{}}, {{}}

def show(values, arrays):
    assert abs(arrays["observations"].mean(axis=0)).max() < 1e-4 and abs(arrays["actions"]).max() <= 1
    return {{}}, {{}}

def train(values, arrays):
    global n
    n += 1
    if n == kwargs.get("die_at"):
        print("out of memory", file=sys.stderr)
        os._exit(3)
    if n == kwargs.get("babble_at"):
        os.write(int(sys.argv[-1]), b"half a message and then some")
    if n == kwargs.get("sleep_at"):
        time.sleep(60)
    return {{"loss": 1.0 / n}}, {{}}

def predict(values, arrays):
    return {{}}, {{"actions": np.full((len(arrays["observations"]), 1), 0.01 * n, dtype=np.float32)}}

def save(values, arrays):
    return {{}}, {{"parameters": np.array([n], dtype=np.uint8)}}

def load(values, arrays):
    global n
    n = int(arrays["parameters"][0])
    return {{}}, {{}}

sys.exit(serve(types.SimpleNamespace(build=build, show=show, train=train, predict=predict, save=save, load=load)))
"""


class Fake(ServedAlgorithm):
    """Served by a script that the test has written."""

    package, method = "fake", "count"
    script = ""

    def _command(self) -> list[str]:
        return [sys.executable, self.script]


@pytest.fixture(autouse=True)
def fake_server(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the script."""
    script = tmp_path_factory.mktemp("fake") / "fake_server.py"
    script.write_text(FAKE_SERVER.format(folder=str(SERVER.parent)), encoding="utf-8")
    monkeypatch.setattr(Fake, "script", str(script))


def make(**options: Any) -> Fake:
    return Fake("MlpPolicy", "Pendulum-v1", demonstrations=record("Pendulum-v1"), seed=0, **options)


def scaled_action(model: Fake) -> float:
    """What the model does in an arbitrary state of the pendulum, whose torques reach 2."""
    return float(model.predict(np.zeros(3, dtype=np.float32), deterministic=True)[0][0]) / 2


# ---------------------------------------------------------------------- frames


def test_a_message_holds_values_and_arrays_bit_for_bit() -> None:
    arrays = {
        "floats": np.array([[1.5, -0.0], [np.nan, np.inf]], dtype=np.float32),
        "empty": np.zeros((0, 3), dtype=np.float64),
        "counts": np.arange(4),
        "flags": np.array([True, False]),
        "transposed": np.arange(6, dtype=np.float32).reshape(2, 3).T,
    }
    values, found = unpack(pack({"ask": "train", "nested": {"a": [1, None]}}, arrays))
    assert values == {"ask": "train", "nested": {"a": [1, None]}}
    assert list(found) == list(arrays)
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def test_objects_are_not_packed_and_what_is_no_message_is_refused() -> None:
    with pytest.raises(ValueError, match="'bad' has the type object"):
        pack({}, {"bad": np.array([object()])})
    message = pack({}, {"x": np.zeros(2, dtype=np.float32)})
    pickled = io.BytesIO()
    np.savez(pickled, values=np.array([{}], dtype=object))
    for damaged in (b"hello, world", b"", message[:-9], message.replace(b"'<f4'", b"'|O8'"), pickled.getvalue()):
        with pytest.raises(ValueError, match="expected values and arrays, found b'"):
            unpack(damaged)


# ---------------------------------------------------------------------- learning, acting, saving


def test_every_step_is_one_gradient_step_of_the_other_process(tmp_path: Path) -> None:
    model = make()
    assert scaled_action(model) == pytest.approx(0.0)
    model.learn(7)
    assert (model.num_timesteps, model._n_updates) == (7, 7)
    assert scaled_action(model) == pytest.approx(0.07, abs=1e-6)


def test_the_other_process_ends_with_the_agent() -> None:
    model = make()
    model.learn(1)
    assert model._process is not None
    process = model._process._process
    model.close()
    assert process.poll() is not None
    model.learn(1)
    process = model._process._process
    del model
    gc.collect()
    assert process.poll() is not None


def test_without_a_seed_every_agent_has_another(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    ask = ServerProcess.ask
    monkeypatch.setattr(
        ServerProcess, "ask", lambda self, what, *args, **values: asked.append(values) or ask(self, what, *args, **values)
    )
    for seed in (None, None, 5):
        Fake("MlpPolicy", "Pendulum-v1", demonstrations=record("Pendulum-v1"), seed=seed).learn(1)
    first, second, third = (values["seed"] for values in asked if "seed" in values)
    assert first != second and third == 5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"learning_rate": 1e-3}, "learning_rate=0.001 has no effect on Fake.*set them in method_kwargs"),
        ({"method_kwargs": {"rate": np.float32(1)}}, "method_kwargs=.* must hold plain values alone"),
    ],
)
def test_what_cannot_reach_the_other_process_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_a_saved_agent_acts_the_same_and_learns_on(tmp_path: Path) -> None:
    model = make().learn(5)
    model.save(tmp_path / "model.zip")
    model.learn(1, reset_num_timesteps=False)  # after it was saved
    loaded = Fake.load(tmp_path / "model.zip")
    assert scaled_action(loaded) == pytest.approx(0.05, abs=1e-6)
    np.testing.assert_array_equal(loaded.normalization, model.normalization)
    with pytest.raises(ValueError, match="set_env"):
        loaded.learn(1)
    loaded.set_env(gym.make("Pendulum-v1"))
    loaded.learn(3, reset_num_timesteps=False)
    assert loaded.num_timesteps == 8
    assert scaled_action(loaded) == pytest.approx(0.08, abs=1e-6)
    again = tmp_path / "again.zip"
    loaded.save(again)
    loaded.close()
    assert scaled_action(Fake.load(again, env=gym.make("Pendulum-v1"))) == pytest.approx(0.08, abs=1e-6)


def test_it_is_evaluated_as_any_other_algorithm() -> None:
    model = make()
    played = play_episodes(model, [gym.make("Pendulum-v1", max_episode_steps=5)], 2, seed=0)
    assert played.lengths.tolist() == [5, 5]
    evaluate_policy(model, model.get_env(), n_eval_episodes=1)


# ---------------------------------------------------------------------- failures


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"die_at": 3}, ServerFailed, r"fake's COUNT has ended \(exit code 3\): out of memory"),
        (
            {"babble_at": 3},
            ServerFailed,
            "fake's COUNT said what is no answer to 'train': bad message length",
        ),
        ({"sleep_at": 3}, ServerFailed, "fake's COUNT gave no answer within 10 seconds"),
        ({"refuse": 1}, ValueError, "fake's COUNT: ValueError: net_arch must be a list"),
    ],
)
def test_a_failing_process_is_one_clear_error_and_is_ended(kwargs: dict, error: type[Exception], message: str) -> None:
    model = make(method_kwargs=kwargs, timeout=10.0)
    with pytest.raises(error, match=message):
        model.learn(5)
    if model._process is not None:
        assert model._process._process.poll() is not None
        with pytest.raises(ServerFailed, match="has ended before"):
            model.learn(1)


def test_the_other_process_ends_with_this_one(tmp_path: Path) -> None:
    code = (
        "import os; from sb3_actpc.baselines.offline.process import ServerProcess; import sys;"
        f"server = ServerProcess([sys.executable, {Fake.script!r}], 'fake', 20); server.ask('build', method_kwargs={{}});"
        "print(server._process.pid, flush=True); os._exit(9)"
    )
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    pid = int(killed.stdout.split()[-1])
    for _ in range(100):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{pid}/stat").exists() and Path(f"/proc/{pid}/stat").read_text().split()[2] == "Z":
            return
        subprocess.run(["sleep", "0.1"], check=True)
    pytest.fail("it still runs")


def test_without_its_environment_the_command_is_named_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SB3_ACTPC_BASELINES", str(tmp_path / "none"))
    record("SparseHopper-v5").save(tmp_path / "shown.npz")
    assert main(["train", "--env", "SparseHopper-v5", "--algo", "cql", "--demonstrations", "shown.npz", "--no-progress"]) == 2
    assert "run sb3-actpc baselines install d3rlpy" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


# ---------------------------------------------------------------------- the environments


def make_nothing(recipe: Any, place: Path, report: Any) -> None:
    """In the place of a virtual environment."""
    (place / "bin").mkdir(parents=True)
    (place / "bin" / "python").touch()


def test_a_python_without_wheels_is_refused_before_anything_is_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installation.sys, "version_info", (3, 13, 0))
    monkeypatch.setattr(installation, "_make", make_nothing)
    with pytest.raises(ValueError, match=r"no wheels for Python 3\.13: install it from Python 3\.10 to 3\.12"):
        install("d3rlpy", tmp_path / "none")
    assert not (tmp_path / "none").exists()


@pytest.mark.skipif(os.name == "nt", reason="other paths")
def test_an_environment_is_made_once_and_half_of_one_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "_make", make_nothing)
    monkeypatch.setattr(installation, "NUMPY_1_PYTHON", sys.version_info[:2])
    with pytest.raises(ImportError, match=r"d3rlpy is not installed in .*: run sb3-actpc baselines install d3rlpy"):
        environment_python("d3rlpy", tmp_path)
    place = install("d3rlpy", tmp_path)
    assert environment_python("d3rlpy", tmp_path) == place / "bin" / "python"
    (place / "mine").touch()
    install("d3rlpy", tmp_path)
    assert (place / "mine").exists()
    (place / installation.COMPLETE).unlink()  # as if it had been stopped
    abandoned, at_work = tmp_path / ".d3rlpy.1234.tmp", tmp_path / ".d3rlpy.5678.tmp"
    abandoned.mkdir()
    at_work.mkdir()
    os.utime(abandoned, (0, 0))
    with pytest.raises(ImportError):
        environment_python("d3rlpy", tmp_path)
    install("d3rlpy", tmp_path)
    assert not (place / "mine").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == [at_work.name, "d3rlpy"]


def test_a_failing_step_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = installation.Recipe((), "import no_such_module")
    monkeypatch.setitem(installation.RECIPES, "d3rlpy", recipe)
    monkeypatch.setattr(installation, "NUMPY_1_PYTHON", sys.version_info[:2])
    assert main(["baselines", "install", "d3rlpy", "--dir", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "No module named 'no_such_module'" in error
    assert list(tmp_path.iterdir()) == []
    assert main(["baselines", "install", "tensorflow", "--dir", str(tmp_path)]) == 2
    assert "choose one of d3rlpy" in capsys.readouterr().err


# ---------------------------------------------------------------------- the packages themselves


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [BCQ, CQL])
def test_the_packages_learn_and_are_loaded_again(algorithm: type[ServedAlgorithm], tmp_path: Path) -> None:
    """Where they are installed, with the shipped settings but for small batches: the losses fall from the first steps on."""
    try:
        environment_python(algorithm.package)
    except ImportError as error:
        pytest.skip(str(error))
    settings = load_preset(algorithm.method, "default")["method_kwargs"]
    shown = replace(record("Pendulum-v1", 4, 40), actions=np.ones((160, 1)))  # one action, whatever is observed
    model = algorithm("MlpPolicy", "Pendulum-v1", demonstrations=shown, seed=0, batch_size=16, method_kwargs=settings)
    falling = {BCQ: "vae_loss", CQL: "critic_loss"}[algorithm]
    losses = [model._server().ask("train")[0][falling] for _ in range(60)]
    assert np.mean(losses[-10:]) < 0.8 * np.mean(losses[:10])
    model.learn(2)
    model.save(tmp_path / "model.zip")
    observations = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    loaded = algorithm.load(tmp_path / "model.zip")
    for one in (model, loaded):
        actions, _ = one.predict(observations, deterministic=True)
        assert actions.shape == (4, 1) and np.isfinite(actions).all() and (np.abs(actions) <= 2).all()
    if algorithm is CQL:  # BCQ samples actions
        np.testing.assert_array_equal(model.predict(observations)[0], loaded.predict(observations)[0])
    loaded.set_env(gym.make("Pendulum-v1"))
    loaded.learn(2, reset_num_timesteps=False)
    with pytest.raises(ValueError, match="no_such_setting"):
        algorithm(
            "MlpPolicy", "Pendulum-v1", demonstrations=record("Pendulum-v1"), method_kwargs={"no_such_setting": 1}
        ).learn(1)
    process = model._process._process
    del model, one
    gc.collect()
    assert process.poll() is not None  # it ended with the agent
