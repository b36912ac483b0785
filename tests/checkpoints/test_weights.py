"""Files from a stranger: loaded without pickle, eval or exec."""

import builtins
import json
import pickle
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest
import safetensors.torch
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecNormalize

from sb3_actpc import ActPC
from sb3_actpc.checkpoints import CheckpointCallback, TrainingStopped, continue_learning, load_checkpoint
from tests.actpc.agents import imitating
from tests.actpc.envs import CountingEnv, demonstrations
from tests.checkpoints.runs import SHORT_WARM_UP, Terminate, assert_same, make_actpc

KEYWORDS: dict[str, Any] = {
    "train_freq": (2, "step"),
    "action_noise": NormalActionNoise(np.zeros(2), 0.1 * np.ones(2)),
    "policy_kwargs": {
        "net_arch": {"pi": [8], "qf": [12, 12]},
        "optimizer_class": th.optim.SGD,
        "memory_history": 7,
        "n_critics": 3,
        "circuit_kwargs": {"activation": "tanh"},
    },
    "learning_rate": lambda progress: 1e-3 * progress,
}


@pytest.fixture
def no_code(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    def refuse(*arguments: Any, **keywords: Any) -> None:
        raise AssertionError("code would be run")

    for module in (pickle, cloudpickle):
        for name in ("load", "loads", "Unpickler"):
            monkeypatch.setattr(module, name, refuse, raising=False)
    monkeypatch.setattr(th, "load", refuse)
    monkeypatch.setattr(builtins, "eval", refuse)
    monkeypatch.setattr(builtins, "exec", refuse)
    return monkeypatch


def test_weights_are_loaded_without_running_code(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    env = VecNormalize(make_vec_env(CountingEnv))
    keywords = {**KEYWORDS, **SHORT_WARM_UP, "tensorboard_log": str(tmp_path)}
    model = ActPC("MlpPolicy", env, demonstrations=demonstrations(), buffer_size=99, **keywords).learn(150)
    assert model.save_weights(tmp_path / "agent") == tmp_path / "agent.safetensors"
    observations = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    expected = model.predict(observations)[0]
    ActPC.from_weights(tmp_path / "agent", VecNormalize(make_vec_env(CountingEnv)))  # importing a module needs exec
    request.getfixturevalue("no_code")
    loaded = ActPC.from_weights(tmp_path / "agent", VecNormalize(make_vec_env(CountingEnv)), buffer_size=50)
    assert (loaded.predict(observations)[0] == expected).all()
    for name, tensor in model.policy.state_dict().items():
        assert th.equal(tensor, loaded.policy.state_dict()[name])
    assert (loaded.gamma, loaded.train_freq, loaded.buffer_size) == (model.gamma, model.train_freq, 50)
    assert loaded.policy.n_critics == 3 and loaded.tensorboard_log is None
    assert loaded.policy.optimizer_class is th.optim.SGD and loaded.learning_rate == 1e-3
    assert np.allclose(loaded.get_vec_normalize_env().obs_rms.mean, env.obs_rms.mean)
    request.getfixturevalue("no_code").undo()
    loaded.learn(150)


def test_a_folder_of_the_same_name_is_not_in_the_way(tmp_path: Path) -> None:
    make_actpc(CountingEnv).save_weights(tmp_path / "agent")
    (tmp_path / "agent").mkdir()
    assert ActPC.from_weights(tmp_path / "agent", make_vec_env(CountingEnv)).num_timesteps == 0
    with pytest.raises(FileNotFoundError, match=r"no file of weights at .*other.safetensors"):
        ActPC.from_weights(tmp_path / "other", make_vec_env(CountingEnv))


def test_weights_with_demonstrations_go_on_learning_from_new_ones(tmp_path: Path) -> None:
    model = make_actpc(CountingEnv, demonstrations=demonstrations(), n_demonstrations=2)
    path = model.learn(30).save_weights(tmp_path / "agent.safetensors")
    loaded = ActPC.from_weights(path, make_vec_env(CountingEnv), demonstrations=demonstrations())
    before = loaded.prior.weights[0].clone()
    loaded.learn(30)
    assert th.equal(before, loaded.prior.weights[0])  # it was trained before, and is not again


def test_what_bc_measured_goes_with_the_weights(tmp_path: Path) -> None:
    model = imitating().learn(20)
    model.save_weights(tmp_path / "weights")
    other = imitating()
    other.set_parameters(model.get_parameters())
    weight = model.actor_guidance.filtered_weight(10_000)
    for again in (ActPC.from_weights(tmp_path / "weights", CountingEnv(), demonstrations=demonstrations()), other):
        assert again.learn(5).actor_guidance.filtered_weight(10_000) == weight > 0.0


def test_a_checkpoint_is_loaded_without_running_code(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    keywords = {**KEYWORDS, "learning_rate": 1e-3}
    model = ActPC("MlpPolicy", make_vec_env(CountingEnv), buffer_size=99, seed=1, **keywords)
    model.learn(150, CheckpointCallback(tmp_path))
    load_checkpoint(ActPC, tmp_path, make_vec_env(CountingEnv))  # importing a module needs exec
    request.getfixturevalue("no_code")
    loaded = load_checkpoint(ActPC, tmp_path, make_vec_env(CountingEnv))
    assert_same(model, loaded.model)


@pytest.mark.parametrize(("std", "noise"), [(0.5, "GaussianNoise(std=0.5)"), (0.0, "None")])
def test_another_noise_replaces_the_stored_one(tmp_path: Path, std: float, noise: str) -> None:
    with pytest.raises(TrainingStopped):
        make_actpc(CountingEnv, action_noise=0.1).learn(60, [Terminate(30), CheckpointCallback(tmp_path)])
    restored = load_checkpoint(ActPC, tmp_path, make_vec_env(CountingEnv), action_noise=std)
    assert repr(continue_learning(restored, CheckpointCallback(tmp_path)).action_noise) == noise


def test_what_cannot_be_named_must_be_given_again(tmp_path: Path) -> None:
    model = make_actpc(CountingEnv, demonstrations=demonstrations(), learning_rate=lambda progress: 1e-3)
    model.learn(30, CheckpointCallback(tmp_path))
    with pytest.raises(ValueError, match=r"learning_rate, demonstrations could not be stored"):
        load_checkpoint(ActPC, tmp_path, make_vec_env(CountingEnv))
    other = {"learning_rate": lambda progress: 1e-3, "demonstrations": demonstrations(n_episodes=2)}
    with pytest.raises(ValueError, match="60 demonstrated transitions, this one 40"):
        load_checkpoint(ActPC, tmp_path, make_vec_env(CountingEnv), **other)
    loaded = load_checkpoint(ActPC, tmp_path, make_vec_env(CountingEnv), **{**other, "demonstrations": demonstrations()})
    assert_same(model, loaded.model)


def test_only_named_classes_are_written_and_read(tmp_path: Path) -> None:
    model = make_actpc(CountingEnv)
    model.policy_kwargs["optimizer_class"] = type("Mine", (th.optim.Adam,), {})
    with pytest.raises(ValueError, match="policy_kwargs cannot be written by name"):
        model.save_weights(tmp_path / "agent")
    model = make_actpc(CountingEnv)
    path = model.save_weights(tmp_path / "agent")
    tensors = safetensors.torch.load_file(path)
    with safetensors.safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["sb3_actpc"])
    refused = ("os.system", "builtins.eval", "torch.load", "torch.nn", "stable_baselines3.common.base_class.BaseAlgorithm")
    for kind in (*({"class": name} for name in refused), {"schedule": ["system"]}, {"call": "x"}):
        header["settings"]["keywords"]["replay_buffer_class"] = kind
        safetensors.torch.save_file(tensors, path, metadata={"sb3_actpc": json.dumps(header)})
        with pytest.raises(ValueError, match=r"is not one of|does not know"):
            ActPC.from_weights(path, make_vec_env(CountingEnv))


def test_files_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = make_actpc(CountingEnv).save_weights(tmp_path / "agent")
    with pytest.raises(FileNotFoundError, match="no file of weights"):
        ActPC.from_weights(tmp_path / "nothing", make_vec_env(CountingEnv))
    with pytest.raises(ValueError, match="trained with observation_space"):
        ActPC.from_weights(path, "MountainCarContinuous-v0")
    with pytest.raises(ValueError, match="was saved without VecNormalize: wrap"):
        ActPC.from_weights(path, VecNormalize(make_vec_env(CountingEnv)))
    with pytest.raises(ValueError, match="does not fit these settings"):
        ActPC.from_weights(path, make_vec_env(CountingEnv), guidance="default")
    with pytest.raises(ValueError, match=r"what was learned depends on policy_kwargs=.*leave it out"):
        clamped = {"net_arch": [16, 16], "actor_kwargs": {"output_activation": "clamp"}}  # would act otherwise
        ActPC.from_weights(path, make_vec_env(CountingEnv), policy_kwargs=clamped)
    (tmp_path / "bad.safetensors").write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match="not a file of save_weights"):
        ActPC.from_weights(tmp_path / "bad.safetensors", make_vec_env(CountingEnv))
    model = make_actpc(CountingEnv)
    model.prior.weights[0].fill_(np.inf)
    with pytest.raises(ValueError, match=r"prior\.weights\.0: weights are not finite"):
        model.save_weights(tmp_path / "agent")


def test_a_noise_without_a_name_is_left_out_with_a_warning(tmp_path: Path) -> None:
    class Mine(NormalActionNoise):
        pass

    model = ActPC("MlpPolicy", make_vec_env(CountingEnv), action_noise=Mine(np.zeros(2), np.ones(2)), seed=0)
    with pytest.warns(UserWarning, match="action_noise=.* has no name and is left out: pass it to from_weights"):
        model.save_weights(tmp_path / "agent")
