"""What 20,000 updates do to a coupled pair: it must keep its direction (slow)."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_actpc.ngc import NGCCircuit, policy_gradient, settle_coupled
from tests.ngc import oracle

N_UPDATES = 20_000
ADAM = {"fused": True}


@pytest.fixture(scope="module")
def transitions() -> dict[str, th.Tensor]:
    """10,000 unnormalised HalfCheetah transitions under smooth random actions; velocities reach ±20."""
    env, rng = gym.make("HalfCheetah-v5"), np.random.default_rng(0)
    rows: dict[str, list] = {"o": [], "a": [], "r": [], "n": []}
    observation, _ = env.reset(seed=0)
    action = np.zeros(6)
    for _ in range(10_000):
        action = 0.8 * action + 0.5 * rng.normal(size=6)
        clipped = np.clip(action, -1, 1).astype(np.float32)
        following, reward, _, over, _ = env.step(clipped)
        for key, value in zip("oarn", (observation, clipped, [reward], following), strict=True):
            rows[key].append(value)
        observation = env.reset()[0] if over else following
    return {key: th.as_tensor(np.array(values), dtype=th.float32) for key, values in rows.items()}


def batch_of(transitions, n=256):
    index = th.randint(0, len(transitions["o"]), (n,))
    return (transitions[key][index] for key in "oarn")


@pytest.mark.slow
def test_the_coupled_pair_follows_the_policy_gradient_at_the_start_and_after_20k_updates(transitions):
    """Default iterative settings (tied feedback): cosine at least 0.9 in every layer at the start, 0.7 at the end."""
    actor = NGCCircuit(17, 6, output_activation="tanh")
    critic = NGCCircuit(23, 6, n_feedback_inputs=6)
    for circuit in (actor, critic):
        circuit.optimizer = th.optim.Adam(circuit.parameter_groups(4e-4), **ADAM)
    for update in range(N_UPDATES + 1):
        o, a, r, n = batch_of(transitions)
        if update % 5000 == 0:
            changes = actor.hebbian_update(settle_coupled(actor, critic, o).actor).weights
            pairs = list(zip(changes, policy_gradient(actor, critic, o).weights, strict=True))
            cosines, ratios = [oracle.cosine(*pair) for pair in pairs], [float(c.norm() / g.norm()) for c, g in pairs]
            print(f"{update} updates: cosine {np.round(cosines, 3)}, norm ratio {np.round(ratios, 3)}")
            assert min(cosines) > (0.9 if update == 0 else 0.7)
        changes = actor.hebbian_update(settle_coupled(actor, critic, o).actor)
        actor.apply_changes(changes)
        target = r + 0.9 * critic.project(th.cat([n, actor.project(n)], dim=1))
        state = critic.settle(th.cat([o, a], dim=1), target)
        critic.apply_changes(critic.hebbian_update(state))
