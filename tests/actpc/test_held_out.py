"""Whether clones are to imitate steps between the demonstrations is asked of episodes that are held out."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_actpc import Demonstrations
from sb3_actpc.actpc import imitation as imitation_module
from sb3_actpc.actpc.cloning import Cloning
from sb3_actpc.actpc.habit import Trials
from sb3_actpc.actpc.held_out import random_numbers_of_its_own, split, typical_error
from sb3_actpc.actpc.imitation import ROOM_DECAY, Imitation
from sb3_actpc.actpc.self_imitation import Episodes
from tests.actpc.agents import imitating

CPU = th.device("cpu")


def episodes(*lengths):
    n = sum(lengths)
    starts = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
    rows = np.arange(n, dtype=np.float32)[:, None]
    return Episodes(rows, -rows, starts, np.repeat(np.arange(len(lengths), dtype=float), lengths))


def test_every_fourth_episode_is_held_out():
    shown, held = split(episodes(2, 3, 1, 4, 2, 2, 2, 1, 3))
    assert shown.observations[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 10, 11, 12, 13, 14, 15, 17, 18, 19]
    assert shown.starts.tolist() == [0, 0, 2, 2, 2, 5, 6, 6, 8, 8, 10, 10, 12, 12, 12]
    assert shown.returns.tolist() == [0, 0, 1, 1, 1, 2, 4, 4, 5, 5, 6, 6, 8, 8, 8]
    assert held.observations[:, 0].tolist() == [6, 7, 8, 9, 16] and held.starts.tolist() == [0, 0, 0, 0, 4]
    assert held.actions[:, 0].tolist() == [-6, -7, -8, -9, -16]
    past, mask = shown.past(np.array([6, 7]), 2)  # the first two steps of an episode
    assert mask.tolist() == [[0, 0], [0, 1]] and past[1, 1, 0] == 10


def test_three_episodes_are_too_few():
    assert split(episodes(4, 4, 4)) is None and split(episodes(4, 4, 4, 4)) is not None


def test_random_numbers_of_its_own_are_nobody_elses():
    def draw():
        return np.random.random(3).tolist(), th.rand(3).tolist()

    np.random.seed(7)
    th.manual_seed(7)
    expected = draw(), draw()
    np.random.seed(7)
    th.manual_seed(7)
    first = draw()
    inside = []
    for _ in range(2):
        with random_numbers_of_its_own(CPU):
            inside.append(draw())
    assert (first, draw()) == expected and inside[0] == inside[1] != first


def test_the_typical_error_is_that_of_most_steps():
    """Of 0, 0.01 and 1, after all updates of the clone."""
    updates = []

    class Clone:
        def project(self, features, memory):
            assert updates == [0, 1, 2] and memory is None
            return features

    cloning = Cloning(Clone(), None, None, 3)
    cloning.update = updates.append
    actions = th.tensor([[0.0, 0.0], [0.1, 0.1], [1.0, 1.0]])
    assert typical_error(cloning, (th.zeros(3, 2), actions, None)) == pytest.approx(0.01)


LENGTH = 40


class Goal(gym.Env):
    observation_space, action_space = spaces.Box(-np.inf, np.inf, (6,)), spaces.Box(-1.0, 1.0, (2,))

    def reset(self, **_):
        return np.zeros(6, dtype=np.float32), {}


def to_a_goal(n_episodes, gain=4.0):
    """A point that a controller of that gain drives to a goal: (position, velocity, goal) -> force. Goals lie far apart."""
    generator, rows = np.random.default_rng(0), []
    for _ in range(n_episodes):
        position, velocity, goal = generator.uniform(-1.0, 1.0, 2), np.zeros(2), generator.uniform(-1.0, 1.0, 2)
        for _ in range(LENGTH):
            force = np.clip(gain * (goal - position) - 2.0 * velocity, -1.0, 1.0)
            rows.append(np.concatenate([position, velocity, goal, force]))
            velocity = velocity + 0.1 * force
            position = position + 0.1 * velocity
    data = np.array(rows)
    return Demonstrations(
        observations=data[:, :6],
        actions=data[:, 6:],
        next_observations=np.roll(data[:, :6], -1, axis=0),
        rewards=(np.arange(len(data)) % LENGTH == LENGTH - 1).astype(float),
        terminations=np.zeros(len(data), dtype=bool),
        episode_starts=np.arange(0, len(data), LENGTH),
        env_id="Goal",
    )


def reaching(n_episodes, **keywords):
    return imitating(Goal, demonstrations=to_a_goal(n_episodes), **keywords)


@pytest.mark.parametrize(("without", "between", "noise"), [(1.0, 1.4, 1.0), (1.0, 1.6, 0.0), (1.0, 0.2, 1.0)])
def test_clones_do_not_imitate_between_where_that_makes_them_less_precise(without, between, noise, monkeypatch):
    asked = []

    def error(self, noise, shown, held):
        asked.append(noise)
        assert len(shown) == 3 * LENGTH and len(held) == LENGTH
        return between if noise else without

    monkeypatch.setattr(Imitation, "_error_when_held_out", error)
    model = reaching(4)
    assert model.imitation.guesses
    assert model.imitation.noise == noise and model.imitation.noise == noise
    assert asked == [0.0, 1.0]  # once
    assert model.imitation.decay == 1.0  # either way


@pytest.mark.parametrize(
    ("n_episodes", "keywords", "noise"),
    [(3, {}, 1.0), (4, {"refresh_kwargs": {"noise": 0.7}}, 0.7), (4, {"actor_warm_start": 0}, 1.0)],
)
def test_nobody_is_asked_without_need_or_by_few(n_episodes, keywords, noise, monkeypatch):
    monkeypatch.setattr(Imitation, "_error_when_held_out", None)
    assert reaching(n_episodes, **keywords).imitation.noise == noise


def test_both_are_asked_with_the_decay_that_they_would_have(monkeypatch):
    made = []
    monkeypatch.setattr(imitation_module, "typical_error", lambda cloning, held: made.append(cloning) or 1.0)
    for decay in (None, 0.3):
        assert reaching(4, refresh_kwargs={"weight_decay": decay}).imitation.noise == 1.0
    assert [one.weight_decay for one in made] == [ROOM_DECAY, ROOM_DECAY, 0.3, 0.3]
    assert {len(one) for one in made} == {5}  # no more than the warm start


def test_asking_changes_no_random_number_of_the_agent():
    drawn = []
    for is_asked in (False, True):
        model = reaching(4)
        if is_asked:
            assert model.imitation.noise in (0.0, 1.0) and model.imitation._noise_helps is not None
        else:
            model.imitation._noise_helps = True
        drawn.append((np.random.random(), float(th.rand(()))))
    assert drawn[0] == drawn[1]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_precise_controller_is_imitated_as_it_is_shown(seed):
    model = reaching(16, policy_kwargs={"net_arch": [64, 64]}, actor_warm_start=600, seed=seed)
    assert model.imitation.guesses
    assert model.imitation.noise == 0.0


@pytest.mark.parametrize(("helps", "noises"), [(True, [1.0, 0.0, 1.0, 0.0]), (False, [0.0, 1.0, 0.0, 1.0])])
def test_every_other_further_clone_imitates_the_other_way(helps, noises):
    model = reaching(4)
    model.imitation._noise_helps = helps
    assert [model.imitation.noise_of(number) for number in range(4)] == noises
    cloning = model.imitation.clone_into(model.policy.make_actor(), 1)
    assert cloning.weight_decay == ROOM_DECAY
    shown = model.imitation.features_of(model.expert.episodes, np.arange(len(model.expert)))
    is_shown = (cloning.sample(50)[0][:, None] == shown).all(2).any(1)
    assert bool(is_shown.all() if helps else not is_shown.any())


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_no_clone_imitates_the_other_way_where_one_is_asked_for(noise):
    model = reaching(4, refresh_kwargs={"noise": noise})
    assert [model.imitation.noise_of(number) for number in range(3)] == [noise] * 3


def test_no_clone_imitates_the_other_way_where_there_is_no_room():
    model = imitating()
    assert not model.imitation.guesses
    assert [model.imitation.noise_of(number) for number in range(3)] == [0.0] * 3


def test_clones_are_tried_in_turn_whatever_their_number_is_by_then(monkeypatch):
    """Also where it was set anew, as for a loaded agent."""
    made, original = [], Imitation.clone_into
    monkeypatch.setattr(Imitation, "clone_into", lambda *given: (made.append(given[2:]), original(*given))[1])
    model = reaching(4, refresh_kwargs={"n_clones": 4})
    model.pretrain()
    for n_left in (3, 5, 1):
        model.trials = Trials(1, n_clones=n_left, n_tried=model.trials.n_tried, imitated_return=1.0, tests_habit=False)
        assert model.trials.begin(0) and model.trials.is_clone and model.trials.n_clones == n_left - 1
        model._make_candidate()
        assert model.trials.forgotten(1).n_tried == model.trials.n_tried
    assert made == [(), (1,), (2,), (3,)]


def test_an_interrupted_question_is_asked_again(monkeypatch):
    model = reaching(4)
    monkeypatch.setattr(Imitation, "_error_when_held_out", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        model.imitation.noise  # noqa: B018
    monkeypatch.setattr(Imitation, "_error_when_held_out", lambda self, noise, *_: 9.0 if noise else 1.0)
    assert model.imitation.noise == 0.0


def test_a_question_that_is_interrupted_leaves_nobody_on_trial(monkeypatch):
    model = reaching(4)
    model.pretrain()
    model.trials.on_trial, model.trials.is_clone, model.trials.n_clones, model.trials.n_tried = True, True, 3, 2
    monkeypatch.setattr(Imitation, "clone_into", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        model._make_candidate()
    assert not model.trials.on_trial and (model.trials.n_clones, model.trials.n_tried) == (4, 1)


def test_a_checkpoint_keeps_the_answer():
    """By the time it is asked again VecNormalize may know something else."""
    model, resumed = (reaching(4).learn(0) for _ in range(2))
    model.imitation._noise_helps, resumed.imitation._noise_helps = False, None
    resumed.restore_checkpoint_state(model.checkpoint_state())
    assert resumed.imitation._noise_helps is False


def test_what_was_answered_before_vec_normalize_knew_anything_is_asked_again(monkeypatch):
    asked = []
    monkeypatch.setattr(Imitation, "_error_when_held_out", lambda self, noise, *_: asked.append(noise) or 1.0)
    model = imitating(VecNormalize(DummyVecEnv([Goal])), demonstrations=to_a_goal(4))
    for number, n_asked in ((None, 2), (0, 4), (1, 4)):  # described, first clone, further one
        if number is not None:
            model.imitation.clone_into(model.policy.make_actor(), number).sample(3)
        assert model.imitation.noise == 1.0 and len(asked) == n_asked


def test_a_warm_start_goes_on_with_demonstrations_that_were_replaced():
    """It was interrupted; what lies between is measured anew."""
    model = reaching(4, refresh_kwargs={"noise": 1.0})
    cloning = model.imitation.clone_into(model.policy.make_actor())
    cloning.sample(20)
    others = to_a_goal(4)
    model.demonstrations = dataclasses.replace(others, observations=others.observations + 100.0)
    model._follow_demonstrations()
    assert cloning.sample(200)[0].abs().max() < 5.0
