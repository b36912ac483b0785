"""Whether actions gain what the critic says: the slope of the one on the other, and what follows from it."""

from functools import partial
from math import exp

import numpy as np
import pytest
import torch as th
from scipy.stats import linregress, norm
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_actpc import ActPC
from sb3_actpc.actpc.calibration import DOUBT, ENOUGH, FEWEST, WINDOW, Calibration, Step
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
        calibration.step(env, *map(float, step), GAMMA)
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


@pytest.mark.parametrize("true_slope", [-0.1, -0.15])
@pytest.mark.parametrize("seed", range(4))
def test_trust_is_the_p_value_of_a_negative_slope_where_that_is_small(true_slope, seed):
    said, gained = drawn(slope=true_slope, seed=seed)
    found, line = played(said, gained), linregress(said, gained)
    p_value = 2 * norm.cdf(-abs(line.slope) / line.stderr)
    assert found.trust == pytest.approx(min(p_value / DOUBT, 1.0) if line.slope < 0.0 else 1.0)
    assert 0.0 < found.trust


@pytest.mark.parametrize(("slope", "trust"), [(1.0, 1.0), (3.0, 1.0), (-1.0, 0.0), (0.01, 1.0)])
def test_a_critic_that_is_surely_wrong_is_not_trusted(slope, trust):
    said, gained = drawn(slope=slope, noise=0.0)
    assert played(said, gained).trust == pytest.approx(trust, abs=1e-6)


def test_before_anything_is_known_nothing_is_disproven():
    calibration = Calibration(2)
    assert (calibration.slope, calibration.error, calibration.trust, calibration.n) == (0.0, 0.0, 1.0, 0.0)
    assert played([1.0] * (FEWEST - 1), [1.0] * (FEWEST - 1)).n == 0.0
    said, gained = drawn(n=int(ENOUGH) - 1, slope=-1.0, noise=0.0)
    assert played(said, gained).trust == 1.0 and played(*drawn(n=int(ENOUGH), slope=-1.0, noise=0.0)).trust == 0.0
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
    calibration.step(1, 100.0, 0.0, 5.0, GAMMA)
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


def test_a_loaded_agents_critic_is_trusted_as_it_was(tmp_path):
    """It is the same critic; other parameters that are given to an agent are another one's."""
    model = imitating(exploration_noise=0.5).learn(100)
    model.save(tmp_path / "agent")
    known = model.calibration.n
    loaded = ActPC.load(tmp_path / "agent", env=model.env)
    assert loaded.calibration.n == known > 0.0
    loaded.set_parameters(model.get_parameters())
    assert loaded.calibration.n == 0.0


def test_trust_is_not_in_the_parameters():
    """It is the calibration's, which a file of weights does not have."""
    assert "trust" not in TrustRegion(1, 2).state_dict()


def test_an_episode_that_goes_on_is_counted_piece_by_piece():
    calibration = Calibration(1)
    for _ in range(int(2.5 * WINDOW)):
        calibration.step(0, 0.0, 1.0, 0.0, GAMMA)
    assert calibration.n == pytest.approx((WINDOW - 1) * (1 + exp(-(WINDOW - 1) / WINDOW)))
    assert len(calibration.running[0]) == WINDOW / 2


@pytest.mark.parametrize("saturated", [False, True])
def test_the_agent_calibrates_its_critic_on_the_noisy_steps_of_every_environment(saturated, monkeypatch):
    """Two environments whose episodes end and are cut; nothing learns, so that the critic can be asked again afterwards."""
    monkeypatch.setattr("sb3_actpc.actpc.habit.PROOF_STEPS", 10**6)  # no verdict
    pays = partial(CountingEnv, lengths=(5, 9, 7, 4), returns=(1.0, 2.0, 3.0))
    model = imitating(DummyVecEnv([pays, pays]), exploration_noise=0.5, alpha_ext=0.5, gamma=GAMMA)
    monkeypatch.setattr(model, "train", lambda *_, **__: None)
    model.pretrain()
    model.policy.spread.fill_(0.5)
    model.set_env(DummyVecEnv([pays, partial(pays, lengths=(6, 3, 8))]))
    if saturated:  # noise that points outwards is lost: such a step is one of the episode nonetheless
        model.actor.circuit.biases[-1].fill_(20.0)
    played_, sample = [], type(model)._sample_action

    def sampled(self, *others):
        roles, seen = list(self.trials.roles), np.array(self._last_obs)
        actions = sample(self, *others)
        played_.append([seen, roles, actions[1]])
        return actions

    stepped = model.env.step
    monkeypatch.setattr(type(model), "_sample_action", sampled)
    monkeypatch.setattr(model.env, "step", lambda actions: played_[-1].append(stepped(actions)) or played_[-1][-1])
    model.learn(160)
    expected = Calibration(2)
    with th.no_grad():
        features = [model.actor.features(th.as_tensor(seen)) for seen, *_ in played_]
        meant = [model.actor.circuit.project(one) for one in features]
        worth = [model.critic.first().project(th.cat([f, m], 1)).mean(1) for f, m in zip(features, meant, strict=True)]
        done, opposite = (
            [
                model.critic.first().project(th.cat([f, (m + sign * (th.as_tensor(step[2]) - m)).clamp(-1.0, 1.0)], 1)).mean(1)
                for f, m, step in zip(features, meant, played_, strict=True)
            ]
            for sign in (1.0, -1.0)
        )
    kinds = set()
    ended = sorted((t, env) for t, step in enumerate(played_) for env in range(2) if step[3][2][env])
    begun = [0, 0]
    for t, env in ended:
        times, begun[env] = range(begun[env], t + 1), t + 1
        if played_[t][1][env] != "actor":
            continue
        terminated = not played_[t][3][3][env]["TimeLimit.truncated"]
        kinds.add((env, terminated))
        values = [worth[time][env].item() for time in times] + [0.0] * terminated
        rewards = [0.5 * float(played_[time][3][1][env]) for time in times]
        gained = [r + GAMMA * after - before for r, after, before in zip(rewards, values[1:], values, strict=False)]
        said = [(done[time][env] - opposite[time][env]).item() / 2.0 for time in times][: len(gained)]
        played(said, gained, expected)
    assert kinds == {(0, True), (0, False), (1, True), (1, False)}
    found = model.calibration
    for name in ("n", "said_squared", "gained_squared", "products"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-3), name


@pytest.mark.parametrize(("curvature", "slope"), [(-100.0, 0.0), (100.0, 0.0), (-100.0, 3.0)])
def test_what_any_noise_costs_is_not_held_against_a_critic(curvature, slope, monkeypatch):
    """It may have its top where the actor acts, or not: its direction alone is tested."""
    model = imitating(exploration_noise=0.1)
    model.learn(2)

    def project(seen):
        features, actions = seen.split([3, 2], 1)
        noise = actions - model.actor.circuit.project(features)
        return curvature * noise**2 + slope * noise

    monkeypatch.setattr(model, "train", lambda *_, **__: None)
    monkeypatch.setattr(model.critic.first(), "project", project)
    said, step = [], Calibration.step
    monkeypatch.setattr(Calibration, "step", lambda self, env, *others: (said.append(others[0]), step(self, env, *others)))
    model.learn(60, reset_num_timesteps=False)
    assert len(said) > 10 and (np.abs(said).max() < 1e-4) == (slope == 0.0)


@pytest.mark.parametrize(
    "keywords",
    [
        {"exploration_noise": 0.0},
        {"policy_kwargs": {"habit": False}},
        {"policy_kwargs": {"trust_radius": 0.0}},
        {"actor_pressure": 0.0},
        {"alpha_in": 1.0},
    ],
)
def test_without_noise_or_a_region_nothing_is_asked(keywords):
    model = imitating(**keywords)
    model.learn(60)
    region = model.policy.trust_region
    assert model.calibration is None or model.calibration.n == 0.0
    assert region is None or float(region.trust) == 1.0


def test_another_critic_is_tested_anew(tmp_path):
    model = imitating(exploration_noise=0.1)
    model.learn(60)
    assert model.calibration.n > 0.0
    model.calibration.n, model.calibration.products, model.calibration.said_squared = 1000.0, -10.0, 20.0
    model.learn(1, reset_num_timesteps=False)
    assert float(model.policy.trust_region.trust) == pytest.approx(model.calibration.trust) and model.calibration.trust < 0.1
    model.set_parameters(model.get_parameters())
    assert model.calibration == Calibration(1)
    model.learn(1, reset_num_timesteps=False)
    assert float(model.policy.trust_region.trust) == 1.0


def test_what_is_known_reaches_the_region(monkeypatch):
    monkeypatch.setattr(Calibration, "trust", 0.25)
    model = imitating(exploration_noise=0.1)
    region = model.policy.trust_region
    follow = type(model)._follow_calibration
    monkeypatch.setattr(type(model), "_follow_calibration", lambda self: follow(self) if self.num_timesteps else None)
    model.learn(30)
    assert float(region.trust) == 0.25


def test_with_another_clone_running_episodes_do_not_count():
    model = imitating(exploration_noise=0.1)
    model.learn(3)
    model.calibration.running[0] = [Step(1.0, 1.0, 1.0)] * 2
    model.trials.is_clone = True
    model._replace_habit(model.policy.candidate, model.trials.is_clone)
    assert model.calibration.running == [[]]


@pytest.mark.parametrize(("trust", "factor"), [(1.0, 2.0), (0.5, 2.0**0.5), (0.0, 1.0)])
def test_outcomes_widen_the_region_as_far_as_the_critic_is_trusted(trust, factor):
    """A learner that is held at its habit ties with it, which says nothing of the pressure."""
    region = TrustRegion(1, 2)
    region.trust.fill_(trust)
    region.resize("tied")
    assert float(region.radius) == pytest.approx(factor)
    region.resize("rejected")
    assert float(region.radius) == pytest.approx(0.7 * factor)
