"""The deployment gate, played with policies whose returns are known."""

import itertools

import numpy as np
import pytest

from sb3_actpc.guidance.policy_selection import PolicySelection, compare

LENGTH = 20  # steps of an episode


class Game:
    """Plays episodes of one environment until ``n_steps``; returns are drawn as the roles' samplers say."""

    def __init__(self, seed: int, incumbent, challenger, **keywords) -> None:
        self.rng = np.random.default_rng(seed)
        self.selection = PolicySelection(1, **keywords)
        self.deployed, self.challenger, self.previous = incumbent, challenger, None
        self.decisions: list[str] = []

    def play(self, n_steps: int) -> None:
        candidate = self.challenger
        for _ in range(n_steps // LENGTH):
            role = self.selection.roles[0]
            players = {"incumbent": self.deployed, "challenger": candidate, "previous": self.previous}
            episode_return = 0.0 if role == "average" else players[role](self.rng)
            for step in range(LENGTH):
                self.selection.step(0, episode_return / LENGTH, step == 0)
            decision = self.selection.end_episode(0, actor_differs=True)
            if decision is not None:
                self.decisions.append(decision)
            if decision == "promoted":
                self.previous, self.deployed = self.deployed, candidate
            elif decision == "rolled back":
                self.deployed = self.previous
            self.selection.begin_episode(0, actor_differs=True)


def noisy(mean: float, std: float):
    return lambda rng: float(rng.normal(mean, std))


def changing(n: int, first: float, later: float):
    """Returns around ``first`` in ``n`` episodes, then around ``later``."""
    played = itertools.count()
    return lambda rng: (first if next(played) < n else later) + float(rng.normal())


def rate(incumbent, challenger, n_steps: int = 4000) -> float:
    """How often the challenger is deployed in the end, of 200 games."""
    games = [Game(seed, incumbent, challenger) for seed in range(200)]
    for game in games:
        game.play(n_steps)
    return float(np.mean([game.deployed is challenger for game in games]))


def test_a_better_policy_is_deployed_and_a_worse_one_is_not():
    assert rate(noisy(100.0, 10.0), noisy(150.0, 10.0)) > 0.98
    assert rate(noisy(100.0, 10.0), noisy(50.0, 10.0)) < 0.02


def test_a_policy_that_fails_in_one_of_three_episodes_seldom_replaces_one_that_never_fails():
    risky = lambda rng: 0.0 if rng.random() < 1 / 3 else 101.0  # noqa: E731
    assert rate(noisy(100.0, 1.0), risky) < 0.15


@pytest.mark.parametrize(
    ("of_average", "of_copy", "differs", "expected"),
    [(90.0, 80.0, True, "promoted"), (90.0, 20.0, True, "rejected"), (90.0, 80.0, False, None), (31.0, 31.0, True, None)],
)
def test_one_evaluation_episode_confirms_an_average_with_far_better_exploration_episodes(
    of_average, of_copy, differs, expected
):
    """A robot that is stuck without noise (20 instead of 90) is not deployed."""
    selection = PolicySelection(1, incumbent_returns=[30.0, 31.0], n_needed=20, worst=10.0, share=1.0)
    for _ in range(4):
        selection.step(0, of_average, True)
        assert selection.end_episode(0, differs) is None
    assert selection.begin_episode(0, differs) == (expected is not None)
    if expected is None:
        assert selection.roles == ["incumbent"]
        return
    assert selection.roles == ["challenger"]
    selection.step(0, of_copy, True)
    assert selection.end_episode(0, differs) == expected
    assert (selection.n_promoted, selection.n_rejected) == (expected == "promoted", expected == "rejected")
    assert selection.incumbent_returns == ([80.0] if expected == "promoted" else [30.0, 31.0])


@pytest.mark.parametrize(("of_average", "begins"), [(200.0, True), (60.0, False)])
def test_one_exploration_episode_is_enough_if_it_is_far_better(of_average, begins):
    """An older copy, of which one evaluation episode is known, makes room."""
    selection = PolicySelection(
        1, incumbent_returns=[30.0, 31.0], challenger_returns=[40.0], has_challenger=True, worst=10.0, share=1.0
    )
    selection.step(0, of_average, True)
    selection.end_episode(0, True)
    assert selection.begin_episode(0, True) == begins
    selection.step(0, of_average, True)
    assert (selection.end_episode(0, False) == "promoted") == begins


def test_a_part_of_an_episode_has_no_return():
    selection = PolicySelection(1)
    selection.step(0, 1.0, False)
    assert selection.end_episode(0, True) is None
    assert selection.exploration_returns == []
    selection.step(0, 1.0, True)
    selection.end_episode(0, True)
    assert selection.exploration_returns == [1.0]


def test_evaluation_takes_a_quarter_of_the_steps_at_most():
    game = Game(0, noisy(100.0, 10.0), noisy(100.0, 10.0))
    game.play(20_000)
    share = game.selection.evaluation_steps / game.selection.steps
    assert 0.2 < share <= 0.25 + LENGTH / 20_000


def test_a_share_of_zero_never_evaluates_after_the_first_step():
    game = Game(0, noisy(1.0, 0.0), noisy(2.0, 0.0), share=0.0)
    game.play(2000)
    assert game.selection.evaluation_steps <= LENGTH


def test_a_lucky_promotion_is_rolled_back():
    """The challenger's first episodes are lucky; later ones are far worse than the incumbent's."""
    incumbent = noisy(100.0, 5.0)
    game = Game(1, incumbent, changing(3, 200.0, 10.0))
    game.play(20_000)
    assert game.decisions[0] == "promoted"
    assert "rolled back" in game.decisions
    assert game.deployed is incumbent


def test_a_policy_that_lost_by_bad_luck_comes_back():
    """It fails in the two episodes that are compared first, and never again."""
    incumbent = changing(2, 0.0, 100.0)
    game = Game(0, incumbent, noisy(50.0, 1.0))
    game.play(4000)
    assert game.decisions[:2] == ["promoted", "rolled back"]
    assert game.deployed is incumbent


def test_the_returns_that_promoted_a_policy_do_not_keep_it():
    """The mean of all its returns stays above the incumbent's, that of the further ones is below."""
    game = Game(0, noisy(20.0, 1.0), changing(2, 100.0, 15.0))
    game.play(2000)
    assert game.decisions[:2] == ["promoted", "rolled back"]


def test_a_policy_that_seldom_succeeds_seldom_stays_deployed():
    """Returns of 0 and 1, as with a reward at the end."""
    succeeds = lambda chance: lambda rng: float(rng.random() < chance)  # noqa: E731
    assert rate(succeeds(0.55), succeeds(0.15)) < 0.05
    assert rate(succeeds(0.55), succeeds(0.95)) > 0.98


@pytest.mark.parametrize("exploration_agrees", [False, True])
def test_a_moderate_margin_is_enough_where_exploration_agrees(exploration_agrees):
    """45 +- 2 next to 32 +- 2, when the worst return was 20: 0.9 standard errors."""
    selection = PolicySelection(1, incumbent_returns=[30.0, 34.0], n_needed=2 + 18 * exploration_agrees, worst=20.0, share=1.0)
    decisions = []
    if exploration_agrees:
        for episode_return in (43.0, 47.0):
            selection.step(0, episode_return, True)
            selection.end_episode(0, True)
    assert selection.begin_episode(0, True)
    for episode_return in (43.0, 47.0):
        if selection.roles == ["challenger"]:
            selection.step(0, episode_return, True)
            decisions.append(selection.end_episode(0, True))
            selection.begin_episode(0, False)
    assert ("promoted" in decisions) == exploration_agrees
    assert decisions


def test_further_episodes_go_on_after_a_challenger_that_interrupted_them():
    selection = PolicySelection(
        1,
        share=1.0,
        worst=0.0,
        incumbent_returns=[50.0] * 3,
        n_deciding=3,
        n_needed=7,
        has_previous=True,
        previous_returns=[10.0],
        has_challenger=True,
        support=[90.0, 90.0],
        roles=["challenger"],
        running=[0.0],
    )
    selection.step(0, 20.0, True)
    assert selection.end_episode(0, False) == "rejected"
    played = []
    for _ in range(10):
        selection.begin_episode(0, False)
        played.append(selection.roles[0])
        selection.step(0, {"incumbent": 50.0, "previous": 10.0, "average": 0.0}[played[-1]], True)
        selection.end_episode(0, False)
    assert played.count("previous") == 3
    assert played.count("incumbent") >= 3
    assert selection.begin_episode(0, True)


def test_equal_returns_of_zero_change_nothing():
    game = Game(0, noisy(0.0, 0.0), noisy(0.0, 0.0))
    game.play(20_000)
    assert set(game.decisions) == {"rejected"}


def test_the_comparison_has_a_pooled_standard_error():
    ours, theirs = np.array([4.0, 6.0, 2.0]), np.array([2.0, 2.5, 2.0])
    gain, error = compare(ours.tolist(), theirs.tolist())
    pooled = (ours.var(ddof=1) + theirs.var(ddof=1)) / 2
    assert gain == pytest.approx(ours.mean() - theirs.mean())
    assert error == pytest.approx(np.sqrt(pooled * 2 / 3))


@pytest.mark.parametrize("n_envs", [1, 8])
def test_several_environments_promote_a_worse_policy_no_more_often_than_one(n_envs):
    """Successes end after 50 steps, failures after 500: of episodes that begin together, successes would count first."""
    chances = {"average": 0.4, "challenger": 0.4, "incumbent": 0.8}
    promoted = []
    for seed in range(60):
        rng, selection, decision = np.random.default_rng(seed), PolicySelection(n_envs), None
        left, returns = np.zeros(n_envs, dtype=int), np.zeros(n_envs)
        while decision is None and selection.steps < 60_000:
            for env in range(n_envs):
                begins = left[env] == 0
                if begins:
                    returns[env] = rng.random() < chances[selection.roles[env]]
                    left[env] = 50 if returns[env] else 500
                left[env] -= 1
                selection.step(env, returns[env] if left[env] == 0 else 0.0, begins)
                if left[env] == 0 and decision is None:
                    decision = selection.end_episode(env, True)
                    selection.begin_episode(env, True)
        promoted.append(decision == "promoted")
    assert np.mean(promoted) < 0.25
