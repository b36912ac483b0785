"""Features that tell what is done, and features that name the episode."""

import dataclasses

import numpy as np
import pytest
import torch as th

from sb3_actpc import ActPC, shipped_demonstrations
from sb3_actpc.actpc import within_episodes
from sb3_actpc.actpc.within_episodes import CONTEXT, error_of_neighbours, feature_weights, share_within
from sb3_actpc.demonstrations.dataset import Demonstrations
from tests.actpc.agents import imitating, make, plain
from tests.actpc.envs import demonstrations

N_EPISODES, LENGTH = 10, 40
EPISODES = np.repeat(np.arange(0, N_EPISODES * LENGTH, LENGTH), LENGTH)


def steps(seed=0):
    """Positions that go up and down within every episode, and what each episode alone has: (N,) both, of unit variance."""
    generator = np.random.default_rng(seed)
    position = generator.uniform(-1.0, 1.0, size=N_EPISODES * LENGTH)
    own = np.repeat(generator.permutation(np.linspace(-1.0, 1.0, N_EPISODES)), LENGTH)
    return (th.as_tensor((x - x.mean()) / x.std(), dtype=th.float32) for x in (position, own))


def test_the_share_within_episodes_is_that_of_an_analysis_of_variance():
    """Two episodes around 0 and 6, of -1 and 1 in turn: 1 of a variance of 1 + 9; around 0 alone all of it; else nothing."""
    inner = th.tensor([1.0, -1.0]).repeat(4)
    between = th.tensor([0.0, 6.0]).repeat_interleave(4)
    features = th.stack([between + inner, inner, between, th.full((8,), 3.0)], dim=1)
    shares = share_within(features, np.array([7, 7, 7, 7, 2, 2, 2, 2]))
    assert shares.tolist() == pytest.approx([0.1**0.5, 1.0, 0.0, 1.0], abs=1e-6)


def test_episodes_of_different_lengths_count_by_their_steps():
    features = th.tensor([[0.0], [2.0], [4.0], [6.0], [9.0]])
    within = (9.0 + 1.0 + 1.0 + 9.0) / 5  # around 3, and around 9
    assert share_within(features, np.array([0, 0, 0, 0, 1]))[0] == pytest.approx((within / np.var([0, 2, 4, 6, 9])) ** 0.5)


def nearly(own):
    """What each episode alone has, and changes little within it: less than a third of its deviation."""
    return own + 0.3 * th.as_tensor(np.random.default_rng(5).normal(size=len(own)), dtype=th.float32)


def test_a_goal_of_long_episodes_never_changes_either():
    """Sums of 40,000 steps lose their digits."""
    goals = th.tensor([0.123456, -1.7, 0.9, 1.1]).repeat_interleave(40_000)[:, None]
    assert share_within(goals, np.arange(160_000) // 40_000)[0] < 0.1 * CONTEXT


def test_what_names_the_episode_is_taken_smaller_where_it_tells_nothing_of_what_is_done():
    position, own = steps()
    features, actions = th.stack([position, nearly(own)], dim=1), (2.0 * position).tanh()[:, None]
    weights = feature_weights(features, actions, EPISODES)
    assert weights[0] > 0.9 and CONTEXT < weights[1] < 0.35
    assert weights.tolist() == share_within(features, EPISODES).tolist()


def test_what_is_needed_keeps_its_size():
    position, goal = steps()
    weights = feature_weights(th.stack([position, nearly(goal)], dim=1), (goal - position).tanh()[:, None], EPISODES)
    assert weights.tolist() == [1.0, 1.0]


def sorting(seed):
    """To the middle, and then to the left or right as a lamp says: features are (position, time, lamp, four names)."""
    generator, rows = np.random.default_rng(seed), []
    for episode in range(N_EPISODES):
        position, lamp, names = generator.normal(size=3) * 0.3, [-1.0, 1.0][episode % 2], generator.normal(size=4)
        for step in range(LENGTH):
            goal = np.array([lamp if step >= 0.6 * LENGTH else 0.0, 0.0, 0.0])
            action = np.clip(3.0 * (goal - position), -1.0, 1.0)
            rows.append(np.concatenate([position, [step], [lamp], names, action]))
            position = position + 0.1 * action
    data = np.array(rows)
    features = (data[:, :9] - data[:, :9].mean(0)) / data[:, :9].std(0)
    return th.as_tensor(features, dtype=th.float32), th.as_tensor(data[:, 9:], dtype=th.float32)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_never_changes_keeps_its_size_though_the_neighbours_tell_better_without_it(seed):
    """It may be a goal: FetchPush was learned by clones that did not see theirs. Here it is the lamp."""
    features, actions = sorting(seed)
    share = share_within(features, EPISODES)
    errors = [error_of_neighbours(features * weights, actions, EPISODES) for weights in (th.ones_like(share), share)]
    assert share[4:].max() < 0.1 * CONTEXT and errors[1] < 0.9 * errors[0]  # rounding, far from either side
    assert feature_weights(features, actions, EPISODES)[4:].tolist() == [1.0] * 5


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_cue_among_names_that_all_change_a_little_keeps_its_size(seed):
    """Without all five of them the others tell better what is done, and better still with the lamp."""
    features, actions = sorting(seed)
    features[:, 4:] += 0.01 * th.as_tensor(np.random.default_rng(seed).normal(size=(len(features), 5)), dtype=th.float32)
    share = share_within(features, EPISODES)
    weights, others = feature_weights(features, actions, EPISODES), [0, 1, 2, 3, 5, 6, 7, 8]
    assert 10.0 * CONTEXT < share[4:].min() and share[4:].max() < 0.02
    assert weights[4] == 1.0
    assert weights[others].tolist() == share[others].tolist()


def test_a_small_gain_changes_nothing(monkeypatch):
    """So it is with gaits, which are the same in every episode: what was measured of them stays as it was."""
    position, own = steps()
    features, actions = th.stack([position, nearly(own)], dim=1), (2.0 * position).tanh()[:, None]
    assert feature_weights(features, actions, EPISODES)[1] < 1.0
    monkeypatch.setattr(within_episodes, "SMALLEST_GAIN", 1.0)
    assert feature_weights(features, actions, EPISODES).tolist() == [1.0, 1.0]


def test_one_episode_says_nothing():
    """It has no others to be asked."""
    rows = slice(0, LENGTH)
    position, own = (one[rows] for one in steps())
    features, actions = th.stack([position, nearly(own)], dim=1), (2.0 * position).tanh()[:, None]
    assert feature_weights(features, actions, EPISODES[rows]).tolist() == [1.0, 1.0]


def test_each_step_is_told_the_mean_of_what_the_nearest_of_the_others_do():
    """Three at most, and of two others two: 0 is told the mean of 1 and 3, and so on."""
    places = th.tensor([[0.0], [1.0], [3.0]])
    assert error_of_neighbours(places, places, np.arange(3)) == pytest.approx((2.0**2 + 0.5**2 + 2.5**2) / 3)
    five = th.tensor([[0.0], [1.0], [2.0], [3.0], [9.0]])
    told = th.tensor([[2.0], [5 / 3], [4 / 3], [1.0], [2.0]])
    assert error_of_neighbours(five, five, np.arange(5)) == pytest.approx(float((told - five).square().mean()))


def test_of_many_steps_some_are_asked(monkeypatch):
    asked = []

    def watched(features, episodes, demonstrated, demonstrated_episodes, n):
        asked.append((len(features), len(demonstrated)))
        return original(features, episodes, demonstrated, demonstrated_episodes, n)

    original = within_episodes.nearest_steps
    monkeypatch.setattr(within_episodes, "nearest_steps", watched)
    monkeypatch.setattr(within_episodes, "MOST_ASKED", 30)
    monkeypatch.setattr(within_episodes, "MOST_ANSWERING", 150)
    position, own = steps()
    weights = feature_weights(th.stack([position, nearly(own)], dim=1), (2.0 * position).tanh()[:, None], EPISODES)
    assert asked == [(30, 150)] * 3 and weights[1] < 1.0  # as they are, by their shares, and the name at its size


def named(n_episodes=6, length=30):
    """Demonstrations whose third observation is nearly the episode's own, and whose actions follow the first."""
    data = demonstrations(n_episodes=n_episodes, length=length)
    generator = np.random.default_rng(3)
    observations = generator.uniform(-1.0, 1.0, size=data.observations.shape).astype(np.float32)
    observations[:, 2] = np.repeat(np.arange(n_episodes), length) + 0.5 * observations[:, 2]
    actions = np.repeat(np.tanh(observations[:, :1]), data.actions.shape[1], axis=1).astype(np.float32)
    return dataclasses.replace(data, observations=observations, actions=actions)


def test_the_agent_takes_them_smaller_unless_told_not_to():
    data, scales = named(), {}
    for asked in (None, "episodes", "demonstrations"):
        model = make(demonstrations=data, observation_normalization=asked)
        scales[asked] = model.actor.normalizer.scale
        model.set_env(model.env)  # fits again, to what is neither normalised nor weighed
        assert th.equal(model.actor.normalizer.scale, scales[asked])
    std = data.observations.std(0)
    assert scales["demonstrations"].tolist() == pytest.approx((1.0 / std).tolist(), rel=1e-5)
    assert th.equal(scales[None], scales["episodes"])
    assert CONTEXT < (scales[None] * std)[2] < 0.25 and ((scales[None] * std)[:2] > 0.9).all()


@pytest.mark.parametrize(
    ("task", "is_weighed"),
    [("Lift-v0", True), ("PickPlaceCan-v0", True), ("Reacher-v5", False), ("Hopper-v5", False), ("HalfCheetah-v5", False)],
)
def test_arms_are_weighed_and_neither_gaits_nor_the_reacher_whose_goal_stays_the_same(task, is_weighed):
    shown = Demonstrations.load(shipped_demonstrations(f"Sparse{task}"))
    observations = th.as_tensor(shown.observations)
    features = (observations - observations.mean(0)) / observations.std(0).clamp_min(1e-4)
    bounds = shown.episode_bounds
    episodes = np.repeat(bounds[:, 0], bounds[:, 1] - bounds[:, 0])
    assert bool((feature_weights(features, th.as_tensor(shown.actions), episodes) < 1.0).any()) == is_weighed


def test_of_wide_observations_those_that_would_be_left_least_are_asked_for(monkeypatch):
    """Each takes as long as all together."""
    asked, data = [], named()
    names = np.arange(len(data.observations)) // 30
    features = th.as_tensor(names[:, None] + np.linspace(1.0, 3.0, 9) * np.random.default_rng(0).normal(size=(len(names), 9)))
    features = features / features.std(0)
    monkeypatch.setattr(within_episodes, "SMALLEST_GAIN", -1.0)  # taken smaller for nothing
    monkeypatch.setattr(within_episodes, "SMALL_SHARE", 2.0)
    monkeypatch.setattr(within_episodes, "MOST_ALONE", 4)
    monkeypatch.setattr(within_episodes, "error_of_neighbours", lambda weighed, *_: asked.append(weighed) or 1.0)
    weights = feature_weights(features, th.as_tensor(data.actions), names)
    alone = [int((one / features)[0].sub(weights).abs().argmax()) for one in asked[2:]]
    assert alone == weights.argsort().tolist()[:4]


def test_a_loaded_agent_does_not_ask_again(tmp_path, monkeypatch):
    model = imitating(demonstrations=named())
    model.save(tmp_path / "new")
    model.learn(10).save(tmp_path / "trained")
    with monkeypatch.context() as then:
        then.delattr("sb3_actpc.actpc.actpc.feature_weights")
        trained = ActPC.load(tmp_path / "trained", env=model.env)
    assert th.equal(trained.actor.normalizer.scale, model.actor.normalizer.scale)
    other = dataclasses.replace(named(), observations=3.0 * named().observations)
    new = ActPC.load(tmp_path / "new", demonstrations=other)  # that has imitated nothing yet
    assert th.allclose(new.actor.normalizer.scale, model.actor.normalizer.scale / 3.0)


def test_weights_of_features_are_kept_in_a_file(tmp_path):
    model = imitating(demonstrations=named())
    path = model.save_weights(tmp_path / "agent")
    acting = ActPC.from_weights(path, model.env)
    assert th.equal(acting.actor.normalizer.scale, model.actor.normalizer.scale)


def test_without_demonstrations_there_are_no_episodes_to_go_by():
    with pytest.raises(ValueError, match="observation_normalization need demonstrations="):
        ActPC("MlpPolicy", "Pendulum-v1", **plain(observation_normalization="episodes"))
