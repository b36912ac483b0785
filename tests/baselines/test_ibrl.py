"""IBRL: a frozen BC policy proposes actions when the agent acts and when it bootstraps."""

from pathlib import Path

import numpy as np
import pytest
import torch as th

from sb3_actpc.baselines import IBRL
from tests.recordings import record

ENV = "Pendulum-v1"


def make(**options: object) -> IBRL:
    small = {"policy_kwargs": {"net_arch": [8], "n_critics": 3}, "learning_starts": 5, "batch_size": 8, "bc_steps": 20}
    return IBRL("MlpPolicy", ENV, demonstrations=record(ENV), buffer_size=100, seed=1, **{**small, **options})


@pytest.mark.parametrize("n_steps", [1, 3])
def test_the_bc_policy_is_trained_once_and_then_stays_as_it_is(tmp_path: Path, n_steps: int) -> None:
    model = make(n_steps=n_steps)
    untrained = {name: tensor.clone() for name, tensor in model.policy.bc.state_dict().items()}
    model.learn(8)
    frozen = {name: tensor.clone() for name, tensor in model.policy.bc.state_dict().items()}
    assert any(not th.equal(untrained[name], frozen[name]) for name in frozen)
    model.learn(8, reset_num_timesteps=False)
    assert all(th.equal(tensor, frozen[name]) for name, tensor in model.policy.bc.state_dict().items())
    model.save(tmp_path / "model.zip")
    rows = record(ENV).observations[:4]
    loaded = IBRL.load(tmp_path / "model.zip")
    np.testing.assert_array_equal(model.predict(rows, deterministic=True)[0], loaded.predict(rows, deterministic=True)[0])


def test_it_takes_the_proposal_that_the_critics_value_more() -> None:
    policy = make().policy
    rows = th.as_tensor(record(ENV).observations[:6])
    with th.no_grad():
        own, proposed = policy.actor(rows), policy.bc_actions(rows)
        values = [th.cat(policy.critic_target(rows, actions), dim=1).amin(dim=1) for actions in (own, proposed)]
        chosen = policy._predict(rows, deterministic=True)
    expected = th.where((values[1] > values[0])[:, None], proposed, own)
    assert th.equal(chosen, expected)


def test_critics_are_layer_normalized() -> None:
    assert sum(isinstance(module, th.nn.LayerNorm) for module in make().policy.critic.modules()) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"demonstrations": None}, "demonstrations=None: IBRL needs demonstrations"),
        ({"policy_kwargs": {"n_critics": 1}}, "n_critics=1 must be at least 2"),
    ],
)
def test_wrong_settings_are_named(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        IBRL("MlpPolicy", ENV, **{"demonstrations": record(ENV), **options})
