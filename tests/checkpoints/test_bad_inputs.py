"""Generated bad inputs: the constructor, the demonstrations' reader and the command line answer with one clear error."""

import inspect
import io
import random
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

from sb3_actpc import ActPC
from sb3_actpc.cli import main
from sb3_actpc.common.demonstrations import Demonstrations
from tests.actpc.envs import CountingEnv
from tests.actpc.test_agent import demonstrations
from tests.checkpoints.test_exact_resume import ACTPC

N_CONSTRUCTOR, N_READER, N_COMMANDS = 80, 80, 40
BAD_ARRAYS: tuple[Any, ...] = (
    np.zeros(0),
    np.zeros((2, 2, 2, 2)),
    np.array(["text"]),
    np.full((60, 3), np.nan),
    np.array([-1, 5, 2]),
    np.full(60, np.inf),
    np.array(1.5),
    np.zeros((61, 3)),
    np.array([0, 2**62]),
    np.array([1j, 2j]),
    np.array([None, {}], dtype=object),
)


def damaged_bytes(rng: random.Random, good: bytes) -> bytes:
    """Cut, flipped, doubled or replaced bytes."""
    kind = rng.randrange(4)
    if kind == 0:
        return good[: rng.randrange(len(good))]
    if kind == 1:
        data = bytearray(good)
        for _ in range(rng.randrange(1, 20)):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        return bytes(data)
    return good[::-1] if kind == 2 else rng.randbytes(rng.randrange(200))


def with_bad_field(rng: random.Random, good: bytes) -> bytes:
    """One field left out, or with another content."""
    with np.load(io.BytesIO(good)) as stored:
        fields = dict(stored)
    name = rng.choice(sorted(fields))
    del fields[name]
    if rng.random() < 0.8:
        fields[name] = rng.choice(BAD_ARRAYS)
    target = io.BytesIO()
    np.savez(target, **fields)
    return target.getvalue()


def test_the_reader_of_demonstrations_names_the_file(tmp_path: Path) -> None:
    demonstrations().save(tmp_path / "good.npz")
    good = (tmp_path / "good.npz").read_bytes()
    assert zipfile.is_zipfile(tmp_path / "good.npz")
    rng = random.Random(0)
    file = tmp_path / "bad.npz"
    refused = 0
    for number in range(N_READER):
        file.write_bytes((damaged_bytes if number % 2 else with_bad_field)(rng, good))
        try:
            Demonstrations.load(file)
        except ValueError as error:
            refused += 1
            assert str(file) in str(error), f"{number}: {error}"
    assert refused > 0.8 * N_READER  # a flipped bit may fall where nothing is stored


def test_the_constructor_names_what_is_wrong() -> None:
    """A bad value is refused by a ValueError, or does no harm to a short training."""
    rng = random.Random(0)
    numbers = (float("nan"), float("inf"), -1, -0.5, 0, 2.5)
    bad: tuple[Any, ...] = (*numbers, "x", "", None, [], {}, (), object(), True, [-1], {"net_arch": [-1]})
    chosen_elsewhere = {"self", "policy", "env", "_init_setup_model", "tensorboard_log", "device"}
    names = [name for name in inspect.signature(ActPC.__init__).parameters if name not in chosen_elsewhere]
    refused = 0
    for _ in range(N_CONSTRUCTOR):
        name, value = rng.choice(names), rng.choice(bad)
        try:
            ActPC("MlpPolicy", make_vec_env(CountingEnv), **{**ACTPC, name: value}).learn(12)
        except ValueError:
            refused += 1
        except Exception as error:
            raise AssertionError(f"{name}={value!r}") from error
    assert refused > N_CONSTRUCTOR / 2


VALUES = ("nan", "inf", "-1", "0", "1e400", "text", "", "[", "{a: 1}", "~", "!!python/name:os.system", "\u221e", "9" * 400)


def test_the_command_line_answers_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    rng = random.Random(0)
    options = ("--steps", "--seed", "--eval-freq", "--eval-episodes", "--n-envs", "--threads", "--checkpoint-freq", "--device")
    texts = ("--env", "--algo", "--preset", "--demonstrations", "--set", "--env-kwarg")
    for number in range(N_COMMANDS):
        arguments = ["train", "--env", "SparseNothing-v9"]
        for option in rng.sample(options + texts, 2):
            arguments += [f"{option}={rng.choice(VALUES)}"]
        try:
            code = main(arguments)
        except SystemExit as stop:  # argparse's own answer
            code = int(stop.code or 0)
        errors = capsys.readouterr().err.strip()
        assert code == 2 and errors, f"{number}: {arguments}"
        assert "Traceback" not in errors and ("\n" not in errors or errors.startswith("usage:")), errors
    assert not list(tmp_path.iterdir())
