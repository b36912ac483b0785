"""Between the demonstrations: neighbours, and what clones imitate there."""

import dataclasses

import numpy as np
import pytest
import torch as th

from sb3_actpc import ActPC
from sb3_actpc.actpc import compiled as compiled_module
from sb3_actpc.actpc import room as room_module
from sb3_actpc.actpc.cloning import Cloning
from sb3_actpc.actpc.imitation import ROOM_DECAY
from sb3_actpc.actpc.room import Room, evenly, nearest_steps
from sb3_actpc.actpc.self_imitation import Episodes
from sb3_actpc.actpc.trust_region import HELD_UNIT, LARGEST_UNHELD, SMALLEST_UNIT
from tests.actpc.agents import imitating, make
from tests.actpc.envs import demonstrations


def room_of(observations, starts, actions=None, returns=None, by_return=False):
    """A room whose features are the observations."""
    n = len(observations)
    actions = np.zeros((n, 1), dtype=np.float32) if actions is None else actions
    shown = Episodes(np.float32(observations), actions, np.array(starts), np.ones(n) if returns is None else np.array(returns))
    return Room(shown, lambda episodes, rows: th.as_tensor(episodes.observations[rows]), by_return)


def test_neighbours_are_the_nearest_steps_of_other_episodes():
    features = th.tensor([[0.0, 0.0], [0.1, 0.0], [1.0, -2.0], [5.0, 5.0], [5.0, 4.0]])
    numbers = np.array([0, 0, 2, 3, 3])
    expected = [[2, 4, -1], [2, 4, -1], [1, 4, -1], [1, 2, -1], [1, 2, -1]]
    for far in (0.0, 4096.0):
        there = features + far
        assert nearest_steps(there, numbers, there, numbers, 3).tolist() == expected
    assert (nearest_steps(features, np.zeros(5), features, np.zeros(5), 2) == -1).all()  # one episode
    assert nearest_steps(th.zeros(1, 2), np.array([-1]), features, numbers, 2).tolist() == [[0, 2]]


def test_steps_between_lie_on_the_plane_that_the_shown_ones_lie_on():
    """Points between points of a linear policy are points of it: without noise nothing of it is blurred."""
    generator = np.random.default_rng(0)
    observations = generator.normal(size=(40, 3))
    actions = np.float32(observations @ [[0.3], [-0.2], [0.1]])
    room = room_of(observations, np.repeat(np.arange(0, 40, 4), 4), actions)
    room.measure(room.shown)
    features = room.features_of(room.shown, np.arange(40))
    moved, turned = room.between(features, th.as_tensor(actions), room.shown.neighbours, 0.0)
    assert not th.isclose(moved, features).any()
    assert turned.numpy() == pytest.approx(moved.numpy() @ np.array([[0.3], [-0.2], [0.1]]), abs=1e-5)


@pytest.mark.parametrize(("apart", "noise", "expected"), [(2.0, 0.5, 0.05), (2.0, 3.0, 0.3), (0.2, 5.0, 0.2)])
def test_a_step_goes_a_share_of_the_way_and_is_moved_by_noise_of_its_own_length(apart, noise, expected):
    """Two parallel lines in steps of 0.1: shares are uniform in [0, 1], and noise is along the way and no longer than it."""
    observations = np.stack([np.tile(np.arange(30) / 10, 2), np.repeat([0.0, apart], 30)], axis=1)
    room = room_of(observations, np.repeat([0, 30], 30), actions=np.float32(np.repeat([[0.0], [1.0]], 30, axis=0)))
    assert room.step == pytest.approx(0.1) and room.is_wide
    room.measure(room.shown)
    assert room.shown.neighbours.tolist() == [[(row + 30) % 60, -1, -1] for row in range(60)]
    rows = np.repeat(np.arange(30), 1000)
    features, actions = room.features_of(room.shown, rows), th.as_tensor(room.shown.actions[rows])
    moved, turned = room.between(features, actions, room.shown.neighbours[rows], noise)
    assert th.equal(moved[:, 0], features[:, 0])
    share = turned[:, 0].double()
    assert share.min() >= 0.0 and share.max() <= 1.0
    assert [share.mean().item(), share.var().item()] == pytest.approx([1 / 2, 1 / 12], rel=0.03)
    rest = moved[:, 1].double() - share * apart
    assert rest.std().item() == pytest.approx(expected, rel=0.03)
    assert rest.mean().item() == pytest.approx(0.0, abs=4 * expected / len(rows) ** 0.5)


def test_every_known_neighbour_is_gone_to_and_a_step_without_one_stays():
    room = room_of([[0.0], [1.0], [-2.0], [9.0]], [0, 1, 2, 3])
    room.measure(room.shown)
    assert room.shown.neighbours[0].tolist() == [1, 2, 3]
    neighbours = np.repeat([[1, 2, -1]], 3000, axis=0)
    moved = room.between(th.zeros(3000, 1), th.zeros(3000, 1), neighbours, 0.0)[0]
    assert float((moved > 0.0).float().mean()) == pytest.approx(0.5, abs=0.05) and (moved != 0.0).all()
    alone = room.between(th.ones(5, 1), th.ones(5, 1), np.full((5, 3), -1), 1.0)
    assert [one.tolist() for one in alone] == [[[1.0]] * 5] * 2


def test_steps_that_are_never_drawn_are_no_neighbours():
    observations, returns = [[0.0], [1.0], [5.0]], [1.0, 0.0, 2.0]
    for by_return, expected in ((True, [2, -1, -1]), (False, [1, 2, -1])):
        room = room_of(observations, [0, 1, 2], returns=returns, by_return=by_return)
        room.measure(room.shown)
        assert room.shown.neighbours[0].tolist() == expected


def parallel_lines(apart, scale=1.0, paid=(1.0, 1.0)):
    """Two, in steps of 0.1."""
    data = demonstrations(n_episodes=2, length=30)
    observations = np.zeros_like(data.observations)
    observations[:, 0] = np.tile(np.arange(30), 2) / 10
    observations[30:, 1] = apart
    rewards = data.rewards * np.repeat(paid, 30)
    return dataclasses.replace(data, observations=scale * observations, rewards=rewards)


@pytest.mark.parametrize("scale", [1.0, 1000.0])
@pytest.mark.parametrize(("apart", "noise"), [(0.08, 0.0), (0.12, 1.0)])
def test_without_a_word_on_it_there_is_noise_where_the_next_episode_is_farther_than_the_next_step(apart, noise, scale):
    """Whatever the unit."""
    data = parallel_lines(apart, scale)
    model = make(demonstrations=data)
    assert model.imitation.noise == noise
    assert f"noise on what the first clone imitates: {noise:g} of" in model.describe()
    assert make(demonstrations=data, refresh_kwargs={"noise": 0.3}).imitation.noise == 0.3


@pytest.mark.parametrize(
    ("apart", "keywords", "expected"),
    [
        (0.12, {}, ROOM_DECAY),
        (0.12, {"noise": 0.0}, ROOM_DECAY),
        (0.08, {"noise": 0.0}, None),
        (0.08, {"noise": 0.3}, ROOM_DECAY),
        (0.08, {}, None),
        (0.08, {"weight_decay": 0.0}, 0.0),
        (0.12, {"weight_decay": 0.4}, 0.4),
    ],
)
def test_clones_that_imitate_between_demonstrations_have_smaller_synapses(apart, keywords, expected, monkeypatch):
    """None stands for the decay of their circuit."""
    made, original = [], Cloning.__init__

    def watched(self, *given):
        original(self, *given)
        made.append(self.weight_decay)

    monkeypatch.setattr(Cloning, "__init__", watched)
    model = imitating(demonstrations=parallel_lines(apart), refresh_kwargs=keywords, observation_normalization="none")
    model.pretrain()
    assert made == [expected]


@pytest.mark.parametrize("noise", [None, 0.0])
@pytest.mark.parametrize(
    ("apart", "paid", "smallest"),
    [
        (0.08, (1.0, 1.0), SMALLEST_UNIT),
        (0.08, (1.0, 2.0), SMALLEST_UNIT),
        (0.12, (1.0, 1.0), HELD_UNIT),
        (0.12, (1.0, 2.0), HELD_UNIT),
        (0.12, (0.0, 0.0), 1.0),
        (0.12, (0.0, -1.0), HELD_UNIT),
    ],
)
def test_the_trust_region_counts_by_the_demonstrations_spread_unless_the_clone_guesses_between_them(
    apart, paid, smallest, noise, monkeypatch
):
    """Then the habit holds the learner, unless nothing was paid."""
    spread = th.tensor([0.01, 0.4])
    monkeypatch.setattr("sb3_actpc.actpc.actpc.spread_of", lambda residuals: spread)
    keywords = {"observation_normalization": "none", "refresh_kwargs": {"noise": noise}}
    model = imitating(demonstrations=parallel_lines(apart, paid=paid), **keywords)
    region = model.policy.trust_region
    assert region.unit.tolist() == [1.0] * len(spread)
    model.pretrain()
    assert region.unit.tolist() == pytest.approx(np.clip(spread, smallest, 1.0))
    assert (float(region.largest) == LARGEST_UNHELD) == (smallest == 1.0)


@pytest.mark.parametrize(
    ("apart", "keywords", "teaches"),
    [
        (0.12, {}, True),
        (0.08, {}, False),
        (0.12, {"demonstrations": parallel_lines(0.12, paid=(1.0, 2.0))}, True),
        (0.12, {"demonstrations": parallel_lines(0.12, paid=(0.0, 0.0))}, False),
        (0.12, {"demonstrations": parallel_lines(0.12, paid=(-2.0, 0.0)), "refresh_kwargs": {"weighting": "uniform"}}, True),
        (0.12, {"refresh_kwargs": {"habit": False}}, False),
        (0.08, {"refresh_kwargs": {"habit": True}}, True),
        (0.12, {"actor_pressure": 0.0}, False),
        (0.12, {"actor_pressure": 0.0, "refresh_kwargs": {"habit": True}}, False),
        (0.12, {"refresh_weight": 0.0}, False),
        (0.12, {"actor_warm_start": 0}, False),  # its habit has learned nothing
        (0.12, {"actor_warm_start": 0, "refresh_kwargs": {"habit": True}}, False),
        (0.12, {"policy_kwargs": {"habit": False}}, False),
        (0.12, {"policy_kwargs": {"trust_radius": 0.0}}, False),
        (0.12, {"policy_kwargs": {"memory_history": 2}}, True),
    ],
)
def test_where_clones_guess_the_habit_teaches_what_it_does_in_the_batchs_states(apart, keywords, teaches):
    model = imitating(**{"demonstrations": parallel_lines(apart), "observation_normalization": "none", **keywords})
    before = model.describe()
    model.learn(40)
    assert [("the habit teaches the learning actor too" in said) for said in (before, model.describe())] == [teaches] * 2
    habit, batch = model.actor.habit, model._sample_batch(16)
    for weights in [] if habit is None else habit.synapses[0]:
        weights.data.mul_(0.5)  # that it is another one
    imitated = model._imitated(batch)
    assert (imitated is None) == (not model.refresh_weight)
    if imitated is None:
        return
    features, actions, memory = imitated
    assert len(features) == len(actions) == (32 if teaches else 16)
    assert (memory is None) == (not model.memory_history) and (memory is None or len(memory) == len(features))
    if teaches:
        assert th.equal(features[16:], batch.features)
        assert th.equal(actions[16:], habit.project(batch.features, batch.memory))
        assert not th.allclose(actions[16:], model.actor.circuit.project(batch.features, batch.memory))


@pytest.mark.parametrize(
    ("asked_for", "keywords", "expected"),
    [
        (0.1, {}, 0.1),
        (0.3, {}, HELD_UNIT),
        (0.1, {"refresh_kwargs": {"habit": False}}, 0.02),
        (0.1, {"actor_pressure": 0.0}, 0.02),
    ],
)
def test_where_the_habit_teaches_the_noise_is_as_wide_as_the_region(asked_for, keywords, expected):
    """The clone errs by less than a fiftieth here, which says nothing of where the learning actor may go."""
    model = imitating(demonstrations=parallel_lines(0.12), exploration_noise=asked_for, **keywords)
    model.learn(1)
    model.policy.spread.fill_(0.02)
    model.policy.trust_region.measure_by(model.policy.spread, True, model._is_taught)
    assert model._exploration((20_000, 2)).std(0) == pytest.approx([expected] * 2, rel=0.05)


@pytest.mark.parametrize("compiled", [False, True])
def test_what_the_habit_teaches_is_learned(compiled, monkeypatch):
    """Whatever is taught next: an update of the actor settles the steps that are imitated and as many states of the batch."""
    monkeypatch.setattr(compiled_module.th, "compile", lambda function, **_: function)
    model = imitating(demonstrations=parallel_lines(0.12), observation_normalization="none", compile=compiled)
    model.learn(40)
    assert (model._compiled is not None) == compiled
    rows, settle = [], model.actor.circuit.settle
    monkeypatch.setattr(model.actor.circuit, "settle", lambda *given: rows.append(len(given[0])) or settle(*given))
    model.train(2, 16)
    assert rows == [32]


@pytest.mark.parametrize("taught", [True, False])
def test_whether_the_habit_teaches_is_decided_once_with_the_region(taught, tmp_path):
    """Whatever is asked for later, and whatever the next demonstrations leave between them."""
    line = parallel_lines(0.12 if taught else 0.08)
    model = imitating(demonstrations=line, observation_normalization="none")
    model.learn(40)
    model.save(tmp_path / "agent")
    others = {"demonstrations": parallel_lines(0.08 if taught else 0.12)}
    for changes in ({"refresh_kwargs": {"habit": not taught}}, others):
        loaded = ActPC.load(tmp_path / "agent", env=model.env, **changes)
        loaded.learn(20)
        assert loaded._is_taught == taught
        assert bool(loaded.policy.trust_region.holds) == taught
    loaded.actor_pressure = 0.0  # imitation alone is taught by nobody
    assert not loaded.learn(20)._is_taught


@pytest.mark.parametrize("lengths", [(40,), (1, 1, 1)])
def test_one_episode_or_episodes_of_one_step_leave_no_room(lengths):
    data = demonstrations(n_episodes=len(lengths), length=lengths[0])
    assert make(demonstrations=data).imitation.noise == 0.0
    assert not make().imitation.noise
    asked_for = make(demonstrations=data, refresh_kwargs={"noise": 0.3})
    assert asked_for.imitation.noise == (0.3 if len(lengths) > 1 else 0.0)


def test_neighbours_in_long_sets_are_some_of_their_steps(monkeypatch):
    monkeypatch.setattr(room_module, "MOST_NEIGHBOURS", 3)  # rows 0, 2 and 4
    room = room_of([[0.0], [1.0], [10.0], [11.0], [30.0]], np.arange(5))
    room.measure(room.shown)
    assert room.shown.neighbours[:, 0].tolist() == [2, 0, 0, 2, 2]


def test_of_long_sets_of_equal_episodes_every_step_has_its_turn():
    """1,000 episodes of 50 steps, of which 1,000 are asked: every fiftieth would be the same step of each."""
    rows = evenly(50_000, 1000)
    assert len(np.unique(rows)) == 1000 and (rows[0], rows[-1]) == (0, 49_999)
    assert len(np.unique(rows % 50)) == 50
    assert evenly(7, 1000).tolist() == list(range(7))


@pytest.mark.parametrize(("most", "expected"), [(5, [1, 2, 1, 2, 3]), (3, [1, 2, 1, 1, 3])])
def test_of_very_long_sets_some_steps_are_measured_and_the_next_ones_take_theirs_but_their_own(most, expected, monkeypatch):
    monkeypatch.setattr(room_module, "MOST_SEARCHES", most)
    room = room_of([[0.0], [3.0], [4.0], [10.0], [30.0]], np.arange(5))
    room.measure(room.shown)
    assert room.shown.neighbours[:, 0].tolist() == expected


def test_own_episodes_are_moved_towards_the_demonstrations():
    data = demonstrations(n_episodes=2, length=50)
    data = dataclasses.replace(data, observations=np.zeros_like(data.observations))
    model = make(demonstrations=data)
    for place in (7.0, -9.0):  # far from both and from each other
        model.imitation.sample(10, 0.5)
        model.replay_buffer.self_imitation.store(np.full_like(data.observations, place), data.actions, 1.0)
    features = model.imitation.sample(20_000, 0.5)[0]
    for place in (7.0, -9.0):
        own = features[features[:, 0] / place > 0.0]
        assert len(own) == pytest.approx(20_000 / 3, rel=0.05)  # three times a hundred steps
        assert own.mean().item() == pytest.approx(place / 2, rel=0.05)
