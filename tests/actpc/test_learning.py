"""The agent learns, with the constructor's defaults: a short case always, Pendulum by ``pytest -m slow``."""

import pytest
from stable_baselines3.common.envs import IdentityEnvBox
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_actpc import ActPC


@pytest.mark.parametrize("settling", ["iterative", "scheduled"])
def test_a_bandit_is_learned_in_400_steps(settling):
    """Reward 1 when the action is within 0.5 of the observation: the untrained agent collects about a quarter."""
    model = ActPC(
        "MlpPolicy",
        IdentityEnvBox(eps=0.5),
        settling=settling,
        learning_rate=1e-3,
        gamma=0.95,
        policy_kwargs={"net_arch": [64, 64]},
        seed=0,
    )
    before = evaluate_policy(model, model.get_env(), 20)[0]
    after = evaluate_policy(model.learn(400), model.get_env(), 20)[0]
    assert before < 60 and after > 90


@pytest.mark.slow
@pytest.mark.parametrize("settling", ["iterative", "scheduled"])
def test_pendulum_swings_up_on_at_least_4_of_5_seeds(settling):
    returns = []
    for seed in range(5):
        model = ActPC("MlpPolicy", "Pendulum-v1", settling=settling, seed=seed).learn(15_000)
        returns.append(round(float(evaluate_policy(model, model.get_env(), 20)[0]), 1))
        print(f"{settling}, seed {seed}: {returns[-1]}", flush=True)
    assert sum(value > -250 for value in returns) >= 4
