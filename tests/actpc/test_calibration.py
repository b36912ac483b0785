"""Whether actions gain what the critic says: the slope of the one on the other, and what follows from it."""

from functools import partial
from math import exp

import numpy as np
import pytest
import torch as th
from scipy.stats import linregress, norm

from sb3_actpc.actpc.calibration import FEWEST, WINDOW, Calibration
from sb3_actpc.actpc.trust_region import FALL, FIRST_MULTIPLIER, RISE, TrustRegion
from tests.actpc.agents import imitating
from tests.actpc.envs import CountingEnv

GAMMA = 0.9


def played(said, gained, calibration=None, env=0, terminated=True, offset=0.0):
    """An episode in which the noise gains ``gained``, by rewards: the values are made up."""
    calibration = calibration or Calibration(1)
    values = np.random.default_rng(len(said)).normal(size=len(said)) + offset
    following = np.append(values[1:], 0.0 if terminated else 100.0)
    for step in zip(said, values, np.asarray(gained) - GAMMA * following + values, strict=True):
        calibration.step(env, *map(float, step))
    calibration.end(env, GAMMA, terminated)
    return calibration


def drawn(n=400, slope=0.5, noise=1.0, seed=0):
    rng = np.random.default_rng(seed)
    said = rng.normal(size=n)
    return said, slope * said + noise * rng.normal(size=n)


def test_it_is_the_regression_of_what_is_gained_on_what_was_said():
    said, gained = drawn()
    found, line = played(said, gained), linregress(said, gained)
    assert found.slope == pytest.approx(line.slope) and found.error == pytest.approx(line.stderr)


@pytest.mark.parametrize("seed", range(4))
def test_trust_is_the_p_value_of_a_negative_slope(seed):
    said, gained = drawn(slope=-0.05, seed=seed)
    found, line = played(said, gained), linregress(said, gained)
    assert found.trust == pytest.approx(2 * norm.cdf(line.slope / line.stderr) if line.slope < 0.0 else 1.0)
    assert 0.0 < found.trust


@pytest.mark.parametrize(("slope", "trust"), [(1.0, 1.0), (3.0, 1.0), (-1.0, 0.0), (0.01, 1.0)])
def test_a_critic_that_is_surely_wrong_is_not_trusted(slope, trust):
    said, gained = drawn(slope=slope, noise=0.0)
    assert played(said, gained).trust == pytest.approx(trust, abs=1e-6)


def test_before_anything_is_known_nothing_is_disproven():
    calibration = Calibration(2)
    assert (calibration.slope, calibration.error, calibration.trust, calibration.n) == (0.0, 0.0, 1.0, 0.0)
    assert played([1.0] * (FEWEST - 1), [1.0] * (FEWEST - 1)).n == 0.0
    assert played([2.0] * 9, [1.0] * 9).trust == 1.0  # said the same of every action: nothing is known


def test_a_critic_that_ranks_states_and_not_actions_has_no_slope():
    """Both are large in one episode and small in the other."""
    calibration = Calibration(1)
    for level in (0.0, 50.0):
        said, gained = drawn(slope=0.0, seed=int(level))
        played(said + level, gained + level, calibration)
    assert abs(calibration.slope) < 3 * calibration.error < 0.2


def test_an_episode_of_long_ago_counts_less():
    once = played(*drawn(slope=1.0, noise=0.0))
    old = once.said_squared, once.products
    said, gained = drawn(n=600, slope=-1.0, noise=0.0, seed=1)
    both, alone = played(said, gained, once), played(said, gained)
    kept = exp(-600 / WINDOW)
    assert both.n == pytest.approx(400 * kept + 600)
    assert both.said_squared == pytest.approx(old[0] * kept + alone.said_squared)
    assert both.products == pytest.approx(old[1] * kept + alone.products) and both.products < 0.0


def test_after_a_time_limit_the_last_step_says_nothing():
    said, gained = drawn(noise=0.0)
    cut = played(said, gained, terminated=False)
    assert cut.n == len(said) - 1 and cut.slope == pytest.approx(0.5)
    assert played(said, gained).n == len(said)


def test_environments_have_episodes_of_their_own():
    calibration = Calibration(2)
    said, gained = drawn()
    calibration.step(1, 100.0, 0.0, 5.0)
    assert played(said, gained, calibration).slope == pytest.approx(played(said, gained).slope)
    assert len(calibration.running[1]) == 1
    again = Calibration(**calibration.checkpoint_state())
    assert again == calibration and again.running[1][0].said == 100.0
    others = calibration.forgotten(3)
    assert others.n == calibration.n and others.running == [[], [], []]


@pytest.mark.parametrize(("trust", "change"), [(1.0, RISE / 2), (0.5, 0.0), (0.25, -FALL), (0.0, -FALL)])
def test_the_region_is_as_wide_as_the_critic_is_trusted(trust, change):
    region = TrustRegion(1, 2)
    region.deviation.fill_(0.5)
    region.trust.fill_(trust)
    actions = th.full((4, 2), 0.5**0.5)
    region.regulate(actions, th.zeros(4, 2), th.ones(4))
    assert float(region.multiplier / FIRST_MULTIPLIER) == pytest.approx(exp(change), rel=1e-4)


def test_trust_is_not_in_the_parameters():
    """It is the calibration's, which a file of weights does not have."""
    assert "trust" not in TrustRegion(1, 2).state_dict()


def test_the_critic_is_asked_of_the_noise_before_the_step_is_learned(monkeypatch):
    model, asked = imitating(partial(CountingEnv, returns=(1.0, 2.0, 3.0)), exploration_noise=0.1, alpha_ext=0.5), []
    real = Calibration.step

    def step(self, env, said, value, reward):
        with th.no_grad():
            features = model.actor.features(model.actor.obs_to_tensor(model._last_obs)[0])
            both = [
                model.critic.first().project(th.cat([features, model.inputs.tensor(actions)], 1)).mean().item()
                for actions in (model._meant, model._last_noisy)
            ]
        asked.append((model.num_timesteps, said, both[1] - both[0], value, both[0], reward))
        real(self, env, said, value, reward)

    store = type(model)._store_transition

    def stored(self, buffer, actions, *others):
        self._last_noisy = actions
        store(self, buffer, actions, *others)

    monkeypatch.setattr(Calibration, "step", step)
    monkeypatch.setattr(type(model), "_store_transition", stored)
    model.learn(60)
    assert 10 < len(asked) < 60  # noisy episodes alone
    for _, said, expected, value, meant, _reward in asked:
        assert said == pytest.approx(expected, abs=1e-5) and value == pytest.approx(meant, abs=1e-5)
    assert any(abs(said) > 1e-4 for _, said, *_ in asked) and {reward for *_, reward in asked} & {0.5, 1.0, 1.5}
    assert model.calibration.n > 0.0
    assert float(model.policy.trust_region.trust) == pytest.approx(model.calibration.trust)


@pytest.mark.parametrize(
    "keywords", [{"exploration_noise": 0.0}, {"policy_kwargs": {"habit": False}}, {"policy_kwargs": {"trust_radius": 0.0}}]
)
def test_without_noise_or_a_region_nothing_is_asked(keywords):
    model = imitating(**keywords)
    model.learn(60)
    region = model.policy.trust_region
    assert model.calibration is None or model.calibration.n == 0.0
    assert region is None or float(region.trust) == 1.0


def test_a_loaded_agent_goes_on_with_what_is_known(tmp_path):
    model = imitating(exploration_noise=0.1)
    model.learn(60)
    model.calibration.products, model.calibration.said_squared = -10.0, 20.0  # a slope of -0.5, which is sure
    model.save(tmp_path / "agent.zip")
    loaded = type(model).load(tmp_path / "agent.zip", env=model.env)
    assert loaded.calibration == model.calibration.forgotten(1)
    loaded.learn(1, reset_num_timesteps=False)
    assert (
        float(loaded.policy.trust_region.trust) == pytest.approx(loaded.calibration.trust) and loaded.calibration.trust < 0.1
    )
