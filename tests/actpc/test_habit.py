"""The habit: who plays which episode, what must be proven, and what follows from it."""

import dataclasses
import json
import os
import signal
import sys
import types
from functools import partial

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_actpc import ActPC
from sb3_actpc.actpc import actpc as actpc_module
from sb3_actpc.actpc import habit as habit_module
from sb3_actpc.actpc.actpc import AVERAGING_RATE
from sb3_actpc.actpc.cloning import Cloning
from sb3_actpc.actpc.habit import (
    ENOUGH_PROOFS,
    KEPT_RETURNS,
    LIKELY,
    MANY_PROOFS,
    MOST_PROOF_STEPS,
    N_PROOFS,
    PROOF_STEPS,
    SURE,
    QuietEpisode,
    Trials,
)
from sb3_actpc.actpc.imitation import Imitation
from sb3_actpc.actpc.self_imitation import imitated_return
from sb3_actpc.actpc.trust_region import FIRST_MULTIPLIER, FOLLOWING_RATE, RADIUS_FACTORS, spread_of
from tests.actpc.agents import QUICK, differ, imitating, make, weights_of
from tests.actpc.envs import CountingEnv, demonstrations
from tests.checkpoints.runs import assert_same, learn_in_two, learn_straight

ONE_CLONE = {"refresh_kwargs": {"n_clones": 1}}
OBSERVATIONS = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)


@pytest.fixture(autouse=True)
def candidates_of_any_age(monkeypatch):
    monkeypatch.setattr(actpc_module, "CANDIDATE_AGE", 0)


def play(trials, episode_return, length=PROOF_STEPS, env=0, has_learned=True):
    """One episode, paid at its end: who played it, and what followed."""
    role = trials.roles[env]
    for step in range(length):
        trials.step(env, episode_return if step == length - 1 else 0.0)
    verdict = trials.end(env, has_learned)
    trials.begin(env)
    return role, verdict


def cast(trials, role, env=0):
    """The episode of ``env`` that is about to begin is played by this one."""
    trials.roles[env] = role
    trials.quiet = [one for one in trials.quiet if one.env != env] + [QuietEpisode(env, role)] * (role != "actor")


def play_quiet(trials, episode_return, length=PROOF_STEPS, env=0):
    """A quiet episode; where a noisy one is due, that one before it, and its return must not matter."""
    if trials.roles[env] == "actor":
        assert play(trials, 1e6, 1, env) == ("actor", None)
    return play(trials, episode_return, length, env)


def tried(habit_return, candidate_returns, length=PROOF_STEPS, trials=None):
    """The verdict of each episode of a candidate, of which all but the last must be None."""
    trials = trials or Trials(1)
    for _ in range(N_PROOFS):
        assert play_quiet(trials, habit_return) == ("habit", None)
    verdicts = []
    for one in candidate_returns:
        role, verdict = play_quiet(trials, one, length)
        assert role == "candidate"
        verdicts.append(verdict)
    return verdicts


# ---------------------------------------------------------------------- the rules


def test_noisy_episodes_and_the_habits_take_turns_and_a_candidate_plays_until_it_is_judged():
    """Two whole episodes are what a tie takes; then the habit is tested again."""
    trials = Trials(1)
    roles = [play(trials, 1.0)[0] for _ in range(17)]
    habit, tie = ["actor", "habit"], ["actor", "candidate", "candidate"]
    assert roles == [*habit, *habit, *tie, *habit, *tie, *habit, *tie]


def test_after_its_first_episodes_a_candidate_takes_turns_with_noise():
    """The learning actor's replay needs it: goals are found by noise."""
    trials = Trials(1, habit_returns=[100.0, 100.0], tests_habit=False)
    roles = [play(trials, paid)[0] for paid in (0.0, 90.0, 110.0, 0.0, 90.0, 0.0)]
    assert roles == ["actor", "candidate", "candidate", "actor", "candidate", "actor"]


@pytest.mark.parametrize(("length", "n"), [(PROOF_STEPS, 1), (PROOF_STEPS - 1, 2), (PROOF_STEPS // 4, 4), (1, ENOUGH_PROOFS)])
def test_after_every_candidate_that_did_not_prove_itself_the_habit_is_tested_as_long_as_one(length, n):
    """However well it is known: what it was accepted for may have been luck."""
    trials = Trials(1)
    assert tried(100.0, [0.0, 0.0], 1, trials)[-1] == "rejected"
    trials.habit_returns = [100.0] * KEPT_RETURNS
    for _ in range(2):
        assert [play_quiet(trials, 100.0, length)[0] for _ in range(n)] == ["habit"] * n
        assert [play_quiet(trials, 0.0, 1) for _ in range(2)] == [("candidate", None), ("candidate", "rejected")]


@pytest.mark.parametrize(("noisy", "quiet", "n"), [(500, 500, 1), (500, 1000, 1), (1, 500, 1), (500, 499, 2), (500, 100, 5)])
def test_as_many_steps_go_without_noise_as_the_noisy_episode_before_them_had(noisy, quiet, n):
    """An episode at least, whatever was quiet before; each environment by itself."""
    trials = Trials(2)
    one = partial(play, trials, 1.0, has_learned=False)
    for _ in range(3):
        assert one(noisy)[0] == "actor"
        assert "actor" not in [one(quiet)[0] for _ in range(n)]
    assert trials.roles == ["actor", "actor"]
    one(200)
    one(7, env=1)
    roles = [(one(50)[0], one(50, env=1)[0]) for _ in range(4)]
    assert [first == "actor" for first, _ in roles] == [False] * 4
    assert [second == "actor" for _, second in roles] == [False, True, False, True]


@pytest.mark.parametrize(
    ("n_habit", "gain", "n"),
    [
        (2, 0.02, 2),  # it has played as often
        (4, 0.02, 4),  # 1/5 - 1/6 after three, nothing after four
        (4, 0.04, 3),
        (4, 0.08, 3),  # 1/4 - 1/6 after two
        (4, 0.09, 2),
        (50, 0.011, 9),  # more than ``ENOUGH_PROOFS`` occasions count for no more
        (50, 0.2, 2),
    ],
)
def test_a_gain_is_worth_the_falls_that_a_candidate_has_had_no_occasion_for(n_habit, gain, n):
    """By the rule of succession: after n episodes without a fall the next one is one with probability 1 / (n + 2)."""
    trials = Trials(1, habit_returns=[100.0] * n_habit, tests_habit=False)
    verdicts = [play_quiet(trials, 100.0 * (1.0 + gain), 1000)[1] for _ in range(n)]
    assert verdicts == [None] * (n - 1) + ["accepted"]


def test_a_fall_on_the_way_to_so_many_episodes_ends_the_trial():
    trials = Trials(1, habit_returns=[100.0] * 6, tests_habit=False)
    assert [play_quiet(trials, paid, 1000)[1] for paid in (102.0, 102.0, 40.0)] == [None, None, "rejected"]


def test_before_anything_is_learned_the_quiet_episodes_are_the_habits():
    trials = Trials(1)
    roles = [play(trials, float(paid), has_learned=False)[0] for paid in range(2 * KEPT_RETURNS + 4)]
    assert roles == ["actor", "habit"] * (KEPT_RETURNS + 2)
    assert trials.habit_returns == [float(paid) for paid in range(5, 2 * KEPT_RETURNS + 4, 2)]  # the last ones


def test_environments_take_turns_by_themselves():
    trials = Trials(2)
    play(trials, 1.0, env=1)
    assert trials.roles == ["actor", "habit"]
    trials.step(0, 0.5)
    trials.step(1, 0.25)
    assert play(trials, 1.0, env=1) == ("habit", None) and trials.habit_returns == [1.25]


@pytest.mark.parametrize(
    ("habit", "candidate", "verdict"),
    [
        (100.0, [101.1, 101.1], "accepted"),
        (100.0, [100.9, 100.9], "tied"),
        (100.0, [100.0, 100.0], "tied"),
        (100.0, [99.1, 99.1], "tied"),
        (100.0, [98.9, 98.9], "rejected"),
        (100.0, [80.1, 80.1], "rejected"),
        (100.0, [79.9], "rejected"),
        (100.0, [0.0], "rejected"),
        (-100.0, [-98.9, -98.9], "accepted"),
        (-100.0, [-99.1, -99.1], "tied"),
        (-100.0, [-100.9, -100.9], "tied"),
        (-100.0, [-119.9, -119.9], "rejected"),
        (-100.0, [-120.1], "rejected"),
        (-100.0, [-1000.0], "rejected"),
        (0.0, [0.0, 0.0], "tied"),
        (0.0, [1.0, 1.0], "accepted"),
        (-3.0, [0.0, 0.0], "accepted"),
        (1.0, [0.0], "rejected"),
    ],
)
def test_a_candidate_must_gain_a_hundredth_and_is_rejected_for_the_loss_of_one(habit, candidate, verdict):
    """In at least two episodes; the loss of a fifth is judged at once."""
    assert tried(habit, candidate) == [None] * (len(candidate) - 1) + [verdict]


def test_a_great_loss_that_may_be_chance_is_not_held_against_a_candidate_at_once():
    """Habit's returns of 50 and 150: squares of 5,000 in one degree of freedom, so 1.5 errors of sqrt(5000 * 1.5) = 87."""
    for first, verdict in ((-49.0, None), (-51.0, "rejected")):
        trials = Trials(1)
        play_quiet(trials, 50.0)
        play_quiet(trials, 150.0)
        assert play_quiet(trials, first)[1] == verdict


@pytest.mark.parametrize(
    ("candidate", "verdicts"),
    [
        ([102.0, 122.0], [None, None]),  # a gain of 12, and 1.5 errors of 10
        ([106.0, 118.0], [None, "accepted"]),  # of 12, and 1.5 errors of 6
        ([90.0, 120.0, 110.0, 110.0], [None, None, None, "accepted"]),  # 7.5, and half of sqrt(475 / 4 * 3 / 4) = 9.4
        ([120.0, 85.0, 115.0, 90.0], [None, None, None, "tied"]),  # 2.5, and half of 13.2
    ],
)
def test_a_gain_must_pass_its_standard_error_and_the_candidate_plays_on_until_it_does(candidate, verdicts):
    """Two habit's returns without spread: the variance is the candidate's squares over its number of episodes."""
    n = len(candidate)
    mean = sum(candidate) / n
    error = (sum((one - mean) ** 2 for one in candidate) / n * (1 / n + 1 / N_PROOFS)) ** 0.5
    enough = LIKELY if n * PROOF_STEPS >= MOST_PROOF_STEPS else SURE
    assert (mean - 100.0 > enough * error) == (verdicts[-1] == "accepted")
    assert tried(100.0, candidate) == verdicts


@pytest.mark.parametrize(
    ("noisy", "is_clone", "n_needed"),
    [([101.0, 101.0], False, 4), ([101.0, 98.0], False, 8), ([101.0], False, 8), ([99.0, 99.0], True, 4)],
)
def test_a_learner_that_noise_makes_worse_than_the_habit_needs_twice_the_steps_for_a_likely_gain(noisy, is_clone, n_needed):
    """A gain of 7.5 by errors of 9.4 and, then, 7.7: of clones the noise says nothing."""
    trials = Trials(1, habit_returns=[100.0, 100.0], tests_habit=False)
    verdicts = []
    for paid in [90.0, 120.0, 110.0, 110.0] * 2:
        trials.on_trial, trials.is_clone, trials.noisy_returns = True, is_clone, noisy
        cast(trials, "candidate")
        verdicts.append(play(trials, paid)[1])
        if verdicts[-1]:
            break
    assert verdicts == [None] * (n_needed - 1) + ["accepted"]


@pytest.mark.parametrize("noisy", [99.0, 101.0])
def test_a_sure_gain_is_proof_whatever_the_noise_does(noisy):
    trials = Trials(1)
    tried(100.0, [90.0], trials=trials)
    trials.candidate_returns, trials.noisy_returns = [118.0, 120.0, 122.0], [noisy] * 4
    cast(trials, "candidate")
    assert play(trials, 120.0, MOST_PROOF_STEPS)[1] == "accepted"


@pytest.mark.parametrize(
    ("candidate", "verdicts"),
    [
        ([90.0, 110.0], [None, None]),  # neither, and 1.5 errors of 10
        ([99.9, 100.1], [None, "tied"]),  # of 0.1
        ([90.0, 106.0], [None, None]),  # a loss of 2, and half an error of 8
        ([90.0, 102.0], [None, "rejected"]),  # of 4, and half of 6
        ([90.0, 106.0, 97.0, 99.0], [None, None, None, "rejected"]),  # it had its steps
        ([90.0, 106.0, 120.0, 120.0], [None, None, None, "accepted"]),
    ],
)
def test_a_loss_that_may_be_chance_is_not_held_against_a_candidate_while_it_has_time(candidate, verdicts):
    """Two habit's returns without spread, as above."""
    assert tried(100.0, candidate) == verdicts


def test_of_short_episodes_a_candidate_may_play_as_many_as_it_takes():
    """Successes of 0 or 1, two fifths against one: 35 episodes tell the two apart by the errors asked for, ten do not."""
    length = MOST_PROOF_STEPS // 40
    for n_needed, paid in ((35, [0.0, 0.0, 1.0, 0.0, 1.0] * 7), (80, [0.0, 1.0, 0.0, 0.0, 0.0] * 16)):
        trials = Trials(1, habit_returns=[0.0, 0.0, 1.0, 0.0, 0.0] * 4, tests_habit=False)
        verdicts = [play_quiet(trials, one, length)[1] for one in paid[:n_needed]]
        assert verdicts == [None] * (n_needed - 1) + ["accepted" if n_needed == 35 else "undecided"]


@pytest.mark.parametrize("noisy", [0.0, 1.0])
@pytest.mark.parametrize(
    ("is_clone", "habit", "length", "candidate", "n_needed", "verdict"),
    [
        (False, [1.0, 0.0], 100, [1.0], MANY_PROOFS, "accepted"),  # in 2000 of 4000 steps
        (True, [1.0, 0.0], 100, [1.0], 5, "accepted"),  # a gain of 0.5 by errors of 0.23, after 500 steps
        (False, [1.0, 0.0], 250, [1.0], 16, "accepted"),  # it had its steps
        (False, [1.0, 0.0], 250, [1.0, 0.0], 16, "undecided"),  # no gain
        (False, [1.0, 0.0], 250, [1.0, 0.0, 1.0, 1.0, 0.0], 32, "undecided"),  # 0.09, and errors of 0.14
        (True, [1.0, 0.0], 250, [1.0, 0.0, 1.0, 1.0, 0.0], 8, "accepted"),  # 0.125, and half of 0.21
        (False, [0.0, 0.0], 100, [1.0], 5, "accepted"),  # nothing to lose
        (False, [-1.0, 0.0], 100, [0.0], 5, "accepted"),  # a cost is not nothing
        (False, [1.0, 0.5], 100, [1.5], 5, "accepted"),  # more than all
        (False, [1.0, 0.0], 250, [0.0], 2, "rejected"),  # a loss is judged as ever
    ],
)
def test_of_a_learner_that_is_paid_all_or_nothing_many_episodes_or_all_of_its_steps_are_asked(
    is_clone, habit, length, candidate, n_needed, verdict, noisy
):
    """Twenty episodes of the habit. The noisy ones, two, may be luck."""
    trials = Trials(1, habit_returns=habit * 10, tests_habit=False)
    verdicts = []
    for paid in (candidate * 20)[:n_needed]:
        trials.on_trial, trials.is_clone, trials.noisy_returns = True, is_clone, [noisy] * 2
        cast(trials, "candidate")
        verdicts.append(play(trials, paid, length)[1])
    assert verdicts == [None] * (n_needed - 1) + [verdict]


def race(trials, candidate, habit=(), length=400):
    """A learner's trial from its 4,000 steps on: who played each quiet episode, and the verdict."""
    trials.on_trial, trials.candidate_steps, trials.habit_is_due = True, MOST_PROOF_STEPS * 2, True
    trials.begin(0)
    paid, roles, verdict = {"candidate": list(candidate), "habit": list(habit)}, [], None
    while verdict is None and paid["candidate"]:
        role = trials.roles[0]
        verdict = play(trials, 0.0 if role == "actor" else paid[role].pop(0), length)[1]
        roles += [role] * (role != "actor")
    return roles, verdict


def test_a_learner_of_all_or_nothing_that_gains_by_chance_perhaps_races_against_the_habit():
    """0.95 of twenty against 1.00: 0.05, and 1.5 errors of 0.05. Four more of the habit, of which two fail, and four of the
    learner's make it 0.125, and 1.5 errors of 0.07."""
    trials = Trials(1, habit_returns=[0.0] + [1.0] * 19, candidate_returns=[1.0] * 20)
    roles, verdict = race(trials, [1.0] * 10, [1.0, 0.0] * 2 + [1.0] * 6)
    assert roles == ["habit", "candidate"] * 4
    assert verdict == "accepted"
    assert trials.habit_returns == [1.0] * 24  # the candidate's: what the habit had is gone


@pytest.mark.parametrize(
    ("n_habit", "candidate", "n_turns", "verdict"),
    [
        (20, [1.0] * 10, 10, "undecided"),  # it has had its 8,000 steps
        (20, [1.0, 0.0], 2, "undecided"),  # it gains no more
        (40, [0.0], 1, "rejected"),  # a loss, by then of any size
    ],
)
def test_a_race_ends_where_the_learner_gains_no_more_or_has_had_its_time(n_habit, candidate, n_turns, verdict):
    trials = Trials(1, habit_returns=[0.0] + [1.0] * (n_habit - 1), candidate_returns=[1.0] * 20)
    roles, ended = race(trials, candidate, [1.0] * 10)
    assert (ended, roles) == (verdict, ["habit", "candidate"] * n_turns)
    assert trials.tests_habit and not trials.on_trial


@pytest.mark.parametrize(("is_clone", "habit"), [(True, [0.0] + [1.0] * 19), (False, [0.5] + [1.0] * 19), (False, [0.0] * 20)])
def test_clones_and_graded_returns_do_not_race(is_clone, habit):
    trials = Trials(1, is_clone=is_clone, habit_returns=habit, candidate_returns=[1.0] * 20)
    assert race(trials, [1.0] * 10)[0] == ["candidate"]


@pytest.mark.parametrize(("missing", "n", "first"), [(0, 20, "habit"), (1, 20, "candidate"), (0, 1, "candidate")])
def test_a_race_begins_where_a_trial_would_end(missing, n, first):
    """Which is after two episodes at least."""
    trials = Trials(1, habit_returns=[0.0] + [1.0] * 19, candidate_returns=[1.0] * n, on_trial=True, habit_is_due=True)
    trials.candidate_steps = MOST_PROOF_STEPS * 2 - missing
    trials.begin(0)
    assert trials.roles == [first]


def test_an_unlucky_row_of_the_habits_episodes_is_no_candidates_chance():
    """Returns of random goals: 80 episodes of 0 and 30 in turn, then 20 of 0 and 18. A candidate of 12 is worse than 13.8, the
    mean of all, and would be better than the 9 of the last."""
    trials = Trials(1)
    for paid in [0.0, 30.0] * 40 + [0.0, 18.0] * 10:
        assert [play(trials, one, 50, has_learned=False)[0] for one in (0.0, paid)] == ["actor", "habit"]
    assert trials.habit_return == pytest.approx(13.8)
    assert play(trials, 0.0, 50) == ("actor", None)
    verdict = None
    while verdict is None:
        role, verdict = play_quiet(trials, 12.0, 50)
        assert role == "candidate"
    assert verdict == "rejected"


def test_the_spread_of_the_habits_own_returns_counts_too():
    """Returns that jump between 0 and 200: two candidate's episodes of 150 are no proof."""
    trials = Trials(1)
    play_quiet(trials, 0.0)
    play_quiet(trials, 200.0)
    assert [play_quiet(trials, 150.0)[1] for _ in range(2)] == [None, None]


@pytest.mark.parametrize(("length", "n_needed"), [(1, ENOUGH_PROOFS), (PROOF_STEPS // 5, 5), (PROOF_STEPS // 4, 4)])
@pytest.mark.parametrize(("paid", "verdict"), [(200.0, "accepted"), (100.0, "tied"), (90.0, "rejected")])
def test_short_episodes_must_be_many_or_add_up(length, n_needed, paid, verdict):
    assert tried(100.0, [paid] * n_needed, length) == [None] * (n_needed - 1) + [verdict]


@pytest.mark.parametrize("length", [1, PROOF_STEPS // 4])
def test_of_a_great_loss_two_short_episodes_are_proof(length):
    assert tried(100.0, [0.0, 0.0], length) == [None, "rejected"]


def test_what_an_accepted_candidate_was_paid_is_the_new_habits_return_and_the_next_candidate_follows():
    trials = Trials(1)
    play_quiet(trials, 100.0)
    play_quiet(trials, 100.0)
    returns = [200.0 + one for one in range(ENOUGH_PROOFS)]
    assert [play_quiet(trials, one, 1)[1] for one in returns][-1] == "accepted"
    assert trials.habit_returns == returns
    play(trials, 0.0)
    assert trials.roles == ["candidate"]


@pytest.mark.parametrize("paid", [[100.0, 100.0], [70.0], [0.0]])
def test_a_habit_that_stays_is_tested_again_and_known_by_the_mean_of_its_last_returns(paid):
    trials = Trials(1)
    assert tried(100.0, paid, trials=trials)[-1] is not None
    assert play_quiet(trials, 70.0) == ("habit", None) and trials.habit_return == 90.0
    trials.habit_returns = [float(one) for one in range(KEPT_RETURNS)]
    trials.tests_habit = True
    play_quiet(trials, 9.0)
    assert trials.habit_returns == [*range(1, KEPT_RETURNS), 9.0]


def test_a_new_candidate_is_taken_before_its_first_episode_and_not_between_its_episodes():
    trials, taken = Trials(1, habit_returns=[100.0]), []
    for paid in (0.0, 100.0, 0.0, 100.0, 0.0, 100.0, 0.0):
        for _ in range(PROOF_STEPS):
            trials.step(0, paid / PROOF_STEPS)
        role = trials.roles[0]
        trials.end(0, True)
        taken.append((role, trials.begin(0)))
    # at the end of: noise, habit, noise (here it is taken), two of the candidate (a loss), noise, habit
    assert taken == [
        ("actor", False),
        ("habit", False),
        ("actor", True),
        ("candidate", False),
        ("candidate", False),
        ("actor", False),
        ("habit", False),
    ]


def test_an_episode_of_a_candidate_that_was_judged_meanwhile_does_not_count():
    trials = Trials(2, habit_returns=[100.0])
    for role in ("actor", "habit", "actor"):
        assert [play(trials, 100.0, env=env)[0] for env in (0, 1)] == [role, role]
    assert trials.roles == ["candidate", "candidate"]
    assert play(trials, 0.0, env=0) == ("candidate", "rejected")
    assert play(trials, 1e6, env=1) == ("candidate", None)
    assert trials.candidate_returns == [] and trials.candidate_steps == 0 and trials.habit_return == 100.0


def test_a_candidate_that_still_plays_when_it_is_judged_does_not_keep_the_next_one_away():
    """The next quiet episode of the other environment must not be played by what was just rejected."""
    trials = Trials(2, habit_returns=[100.0])
    for role in ("actor", "habit", "actor"):
        assert [play(trials, 100.0, env=env)[0] for env in (0, 1)] == [role, role]
    assert play(trials, 0.0, env=0) == ("candidate", "rejected")
    play(trials, 0.0, env=0)
    assert play(trials, 100.0, env=0) == ("habit", None)
    trials.end(0, True)
    assert trials.roles == ["actor", "candidate"] and trials.begin(0)
    assert trials.roles == ["candidate", "candidate"] and trials.on_trial


def test_what_the_old_habit_has_begun_elsewhere_is_no_return_of_the_new_one():
    trials = Trials(2, habit_returns=[100.0, 100.0])
    cast(trials, "candidate", 0)
    cast(trials, "habit", 1)
    trials.candidate_returns, trials.candidate_steps = [200.0], PROOF_STEPS
    assert play(trials, 200.0, env=0) == ("candidate", "accepted")
    play(trials, 50.0, env=1)
    assert trials.habit_returns == [200.0, 200.0]


def accepted(is_clone=False, **keywords):
    """Trials whose habit, a learner or a clone, has 120 of two episodes, after one that had 100, 110 and 90."""
    trials = Trials(1, habit_returns=[100.0, 110.0, 90.0], tests_habit=False, on_trial=True, is_clone=is_clone, **keywords)
    cast(trials, "candidate")
    assert [play(trials, one)[1] for one in (118.0, 122.0)] == [None, "accepted"]
    return trials


@pytest.mark.parametrize(
    ("paid", "verdicts"),
    [
        ([60.0], [None]),  # 100 in the mean, as the one before
        ([59.0], ["recalled"]),
        ([110.0, 90.0, 59.0], [None, None, "recalled"]),  # 99.8 of five
        ([110.0, 90.0, 61.0], [None] * 3),
    ],
)
def test_a_habit_that_is_paid_less_in_the_end_than_the_one_before_it_gives_way_to_that_again(paid, verdicts):
    trials = accepted()
    for one, verdict in zip(paid, verdicts, strict=True):
        generation = trials.generation
        cast(trials, "habit")
        assert play(trials, one)[1] == verdict and trials.generation == generation + (verdict is not None)
    if verdict is None:
        assert trials.habit_returns == [118.0, 122.0, *paid] and trials.former_returns == [100.0, 110.0, 90.0]
        return
    assert trials.habit_returns == [100.0, 110.0, 90.0] and not trials.former_returns and trials.tests_habit
    cast(trials, "habit")
    assert play(trials, 0.0)[1] is None and trials.habit_return == 75.0  # there is nobody to go back to


def test_a_habit_is_followed_by_the_last_one_alone():
    trials = accepted()
    cast(trials, "candidate")
    trials.on_trial = True
    assert [play(trials, one)[1] for one in (150.0, 150.0)] == [None, "accepted"]
    assert trials.former_returns == [118.0, 122.0]


@pytest.mark.parametrize("is_clone", [False, True])
def test_who_is_on_trial_when_a_habit_is_recalled_is_dropped(is_clone):
    """It was weighed against another; and after a clone nothing has been learned from the recalled one."""
    trials = accepted(is_clone, has_learned=True, noisy_returns=[3.0, 4.0])
    trials.on_trial, trials.candidate_returns, trials.candidate_steps, trials.n_rejected = True, [300.0], PROOF_STEPS, 1
    trials.has_learned, trials.noisy_returns = True, [3.0, 4.0]
    cast(trials, "habit")
    assert play(trials, 0.0)[1] == "recalled"
    assert not trials.on_trial and trials.candidate_returns == [] and trials.candidate_steps == 0 and not trials.n_rejected
    assert trials.has_learned == (not is_clone) and trials.noisy_returns == ([] if is_clone else [3.0, 4.0])


def test_a_recall_is_no_early_clone():
    """The second of the early ones is still due."""
    trials = Trials(1, n_clones=5, imitated_return=1000.0, habit_returns=[300.0, 300.0], tests_habit=False)
    trials.on_trial = trials.is_clone = True
    cast(trials, "candidate")
    assert [play(trials, 550.0, has_learned=False)[1] for _ in range(2)] == [None, "accepted"]
    cast(trials, "habit")
    assert play(trials, 0.0, has_learned=False)[1] is None
    cast(trials, "habit")
    assert play(trials, -300.0, has_learned=False)[1] == "recalled"
    assert trials.needs_clone()


def test_what_a_habit_has_begun_elsewhere_is_no_return_of_the_recalled_one():
    trials = Trials(2, habit_returns=[120.0, 120.0], former_returns=[100.0, 100.0])
    for env in (0, 1):
        cast(trials, "habit", env)
    assert play(trials, 0.0, env=0) == ("habit", "recalled")
    play(trials, 0.0, env=1)
    assert trials.habit_returns == [100.0, 100.0]


def test_of_several_environments_episodes_count_in_the_order_in_which_they_began():
    """Else the shortest, a bad gait's falls, would be all that a candidate is judged by."""
    trials = Trials(2, habit_returns=[100.0, 100.0], tests_habit=False, has_learned=True)
    for env in (0, 1):
        play(trials, 0.0, 1, env)
    assert trials.roles == ["candidate", "candidate"]
    for paid in (10.0, 20.0):  # sure great losses, if they counted
        assert play(trials, paid, 10, env=1) == ("candidate", None) and not trials.candidate_returns
    assert play(trials, 300.0, 900) == ("candidate", None) and trials.candidate_returns == [300.0, 10.0, 20.0]
    habits = Trials(2)
    for env in (0, 1):
        play(habits, 0.0, 1, env, has_learned=False)
    play(habits, 5.0, env=1, has_learned=False)
    assert habits.habit_returns == []
    play(habits, 7.0, has_learned=False)
    assert habits.habit_returns == [7.0, 5.0]


def test_noisy_episodes_count_after_a_second_beginning_too():
    trials = Trials(1, generation=3, habit_returns=[1.0])
    trials.begin_all()
    play(trials, 8.0)
    assert trials.noisy_returns == [8.0]


@pytest.mark.parametrize(
    ("habit", "paid", "gain"),
    [
        ([8.0, 12.0], 11.0, 0.1),
        ([8.0, 12.0], 4.0, -0.6),
        ([8.0, 12.0], 90.0, 1.0),
        ([8.0, 12.0], -5.0, -1.0),
        ([-40.0], -30.0, 0.25),
        ([-40.0], -50.0, -0.25),
        ([0.0, 0.0, 0.0, 40.0], 25.0, 0.5),  # of the 30 that its best episode is beyond its mean
        ([0.0, 0.0, 0.0, 40.0], 0.0, -1 / 3),
        ([0.0], 3.0, 1.0),
        ([0.0], 0.0, 0.0),
        ([0.0], -3.0, -1.0),
        ([], 3.0, 0.0),
    ],
)
def test_what_a_noisy_episode_gains_is_a_share_of_what_the_habit_is_paid_or_can_be(habit, paid, gain):
    trials = Trials(1, habit_returns=habit)
    trials.step(0, paid - 1.0)
    trials.step(0, 1.0)
    assert trials.noisy_gain(0) == pytest.approx(gain)


@pytest.mark.parametrize("n_successes", [1, 2, 5, 9])
def test_paid_all_or_nothing_a_learner_gains_in_the_mean_where_it_succeeds_more_often(n_successes):
    """Of ten episodes of the habit so many: whatever that is, the same share of them gains nothing."""
    trials = Trials(1, habit_returns=[1.0] * n_successes + [0.0] * (10 - n_successes))
    gains = []
    for paid in (0.0, 1.0):
        trials.returns = [paid]
        gains.append(trials.noisy_gain(0))
    for share in (0.1, 0.5, 0.9):
        mean = share * gains[1] + (1.0 - share) * gains[0]
        assert np.sign(round(mean, 9)) == np.sign(round(share - n_successes / 10, 9))


def test_quiet_episodes_and_those_of_a_learner_of_before_gain_nothing():
    trials = Trials(2, habit_returns=[1.0], tests_habit=True)
    play(trials, 3.0)
    trials.step(0, 3.0)
    trials.step(1, 3.0)
    assert trials.roles == ["habit", "actor"]
    assert (trials.noisy_gain(0), trials.noisy_gain(1)) == (0.0, 1.0)
    trials.generation += 1
    assert trials.noisy_gain(1) == 0.0


@pytest.mark.parametrize(
    ("keywords", "n_gains"),
    [({}, 2), ({"refresh_kwargs": {"n_clones": 1, "habit": False}}, 0), ({"policy_kwargs": {"trust_radius": 0.0}}, None)],
)
def test_a_radius_follows_the_learners_episodes_once_the_critic_presses(keywords, n_gains):
    """Episodes of ten steps: the learner's are paid 30, the habit's 20. Before the 31st update nobody presses."""
    ten = partial(CountingEnv, lengths=(10,), returns=(30.0, 20.0), cut=(True,))
    model = imitating(ten, **{"critic_warmup": 30, "refresh_kwargs": {"n_clones": 1, "habit": True}, **keywords})
    region = model.policy.trust_region
    assert (region is None) == (n_gains is None)
    for n_steps, n_followed in ((40, 0), (10, 1), (10, 1), (10, 2)):
        model.learn(n_steps, reset_num_timesteps=not model.num_timesteps)
        if region is not None:
            expected = 0.25 * np.exp(FOLLOWING_RATE * 0.5 * min(n_followed, n_gains))
            assert float(region.radius) == pytest.approx(expected)


def test_an_accepted_clone_begins_with_the_first_radius_and_is_held_whatever_is_pressed_meanwhile():
    """Elsewhere outcomes have made the radius, and it stays."""
    for held in (True, False):
        model = imitating(refresh_kwargs={"habit": held})
        model.learn(20)
        region = model.policy.trust_region
        region.radius.fill_(3.0)
        model.actor_pressure = 0.0
        model.trials.is_clone = True
        model._replace_habit(model.policy.candidate, model.trials.is_clone)
        assert float(region.radius) == (0.25 if held else 3.0)
        assert bool(region.holds) == held


def test_a_reset_of_the_environments_forgets_running_episodes_and_nothing_else():
    trials = Trials(2)
    play_quiet(trials, 100.0)
    play_quiet(trials, 50.0, 3)
    trials.step(0, 7.0)
    known = trials.habit_returns, trials.candidate_returns, trials.candidate_steps, trials.generation
    trials.begin_all()
    assert trials.roles == ["actor", "actor"] and trials.returns == [0.0, 0.0] and trials.lengths == [0, 0]
    assert trials.quiet == []
    assert (trials.habit_returns, trials.candidate_returns, trials.candidate_steps, trials.generation) == known


def test_trials_that_were_stored_go_on_as_they_would_have():
    trials = Trials(2)
    for paid in (1.0, 5.0, 1.0, 2.0):
        play(trials, paid, 20, env=1)
    trials.step(0, 0.5)
    again = Trials(**json.loads(json.dumps(trials.checkpoint_state())))
    assert again == trials
    for paid in (9.0, 9.0, 1.0, 4.0, 3.0, 9.0):
        for env in (0, 1):
            assert play(trials, paid, env=env) == play(again, paid, env=env)
    assert again == trials


def play_clones(trials, *paid, has_learned=False):
    """Quiet episodes with these returns: who played each, what followed, and whether a clone was to be made for it."""
    played = []
    for one in paid:
        clone = False
        if trials.roles[0] == "actor":
            trials.end(0, has_learned)
            clone = trials.begin(0) and trials.is_clone
        played.append((*play(trials, one, has_learned=has_learned), clone))
    return played


def test_while_nothing_is_learned_and_the_habit_is_paid_less_than_half_of_what_it_imitates_clones_are_tried():
    """
    The habit is known before a clone is tried, and better after one that is no better; none where it is half as good. Two
    alone: where these do no better, the habit is no exception.
    """
    poor = Trials(1, imitated_return=1000.0, n_clones=9)
    assert play_clones(poor, 40.0, 40.0, 0.0, 40.0, 0.0)[2::2] == [("candidate", "rejected", True)] * 2
    assert play_clones(poor, *[40.0] * 4) == [("habit", None, False)] * 4 and poor.n_clones == 7
    trials = Trials(1, imitated_return=100.0, n_clones=2)
    assert play_clones(trials, 40.0, 50.0) == [("habit", None, False)] * 2
    assert play_clones(trials, 10.0) == [("candidate", "rejected", True)]
    assert play_clones(trials, 45.0) == [("habit", None, False)]
    assert play_clones(trials, 60.0, 60.0) == [("candidate", None, True), ("candidate", "accepted", False)]
    assert play_clones(trials, 60.0, 60.0) == [("habit", None, False)] * 2 and trials.n_clones == 0
    decent = Trials(1, imitated_return=100.0, n_clones=2)
    assert play_clones(decent, 51.0, 55.0, 52.0) == [("habit", None, False)] * 3 and decent.n_clones == 2


@pytest.mark.parametrize(
    ("imitated", "paid", "n_clones", "is_needed"),
    [
        (100.0, 89.0, 1, True),
        (100.0, 91.0, 1, False),
        (100.0, 0.0, 1, True),
        (100.0, 0.0, 0, False),
        (0.0, 0.0, 1, False),
        (-100.0, -111.0, 1, True),
        (-100.0, -109.0, 1, False),
    ],
)
def test_a_clone_is_needed_where_a_tenth_of_what_is_imitated_is_missing(imitated, paid, n_clones, is_needed):
    trials = Trials(1, imitated_return=imitated, n_clones=n_clones, habit_returns=[paid, paid], n_rejected=1, has_learned=True)
    assert trials.needs_clone() == is_needed


def test_clones_imitate_with_noise_and_the_learning_actor_without(monkeypatch):
    seen, original = [], Imitation.sample
    monkeypatch.setattr(Imitation, "sample", lambda self, n, noise=0.0: (seen.append(noise), original(self, n, noise))[1])
    model = imitating(refresh_kwargs={"noise": 0.5}, policy_delay=1)
    shown = model.imitation.features_of(model.expert.episodes, np.arange(len(model.expert)))
    refreshed, cloned = (original(model.imitation, 64, *noise)[0][:, None] for noise in ((), (0.5,)))
    assert [bool((one == shown).all(2).any(1).all()) for one in (refreshed, cloned)] == [True, False]
    model.learn(20)
    n = 4 * model.actor_warm_start  # of three members and the clone
    assert seen[:n] == [0.5] * n and seen[n:] and not any(seen[n:])
    model.trials.on_trial = model.trials.is_clone = True
    seen.clear()
    model._make_candidate()
    assert seen == [0.5] * n


def test_own_episodes_are_measured_anew_from_other_demonstrations():
    model = imitating(refresh_kwargs={"noise": 0.5}, env=lambda: CountingEnv(returns=(1.0,)))
    model.learn(60)
    model.imitation.sample(9, 0.5)
    own, shown = model.replay_buffer.self_imitation, model.expert.episodes
    before = own.episodes.neighbours[:5].copy()
    data = demonstrations()
    model.demonstrations = dataclasses.replace(data, observations=data.observations + 3.0)
    model.learn(0, reset_num_timesteps=False)  # nothing is stored
    model.imitation.sample(9, 0.5)
    assert model.expert.episodes is not shown
    assert (own.episodes.neighbours[:5] != before).any()


def test_once_something_is_learned_a_clone_is_tried_after_a_rejected_learner_and_then_the_learner_again():
    trials = Trials(1, imitated_return=100.0, n_clones=2)
    play_clones(trials, 50.0, 50.0, has_learned=True)  # the habit
    kinds = []
    for paid in (0.0, 0.0, 50.0, 0.0, 0.0):
        [(role, verdict, is_clone)] = play_clones(trials, paid, has_learned=True)
        kinds.append(is_clone)
        while verdict is None:
            [(role, verdict, again)] = play_clones(trials, paid, has_learned=True)
            assert not again
        assert role == "candidate"
        assert play_clones(trials, 50.0, has_learned=True) == [("habit", None, False)]
    # a rejected learner, a rejected clone, a learner's tie, another rejected learner, and the last clone
    assert kinds == [False, True, False, False, True] and trials.n_clones == 0


@pytest.mark.parametrize(
    ("noisy", "is_needed"),
    [
        ([60.0], True),  # one episode is chance
        ([60.0, 41.0], False),
        ([60.0, 39.0], True),
        ([90.0, 10.0, 60.0], True),  # the last two
        ([10.0, 50.0, 60.0], False),
    ],
)
def test_no_clone_is_needed_while_the_rejected_learner_does_better_even_with_noise(noisy, is_needed):
    trials = Trials(1, imitated_return=100.0, n_clones=1, n_rejected=1)
    for one in noisy:
        trials.roles[0] = "actor"
        play(trials, one, 3)
    trials.habit_returns = [50.0, 50.0]
    assert trials.needs_clone() == is_needed
    trials.n_rejected = 2  # noise can keep an actor up that falls without: the second is no chance
    assert trials.needs_clone()
    trials.n_rejected = 0
    assert not trials.needs_clone()


@pytest.mark.parametrize("is_clone", [True, False])
def test_what_was_paid_with_noise_before_a_clone_was_accepted_does_not_count(is_clone):
    trials = Trials(1, imitated_return=100.0, n_clones=2)
    play_clones(trials, 10.0, 10.0, 60.0, has_learned=True)
    trials.is_clone, trials.noisy_returns = is_clone, [7.0, 8.0]
    cast(trials, "candidate")
    assert play(trials, 60.0)[1] == "accepted"
    assert trials.noisy_returns == ([] if is_clone else [7.0, 8.0])


def test_of_learners_that_noise_keeps_up_every_second_in_a_row_is_followed_by_a_clone():
    trials = Trials(1, imitated_return=100.0, n_clones=2)
    candidates = []
    for _ in range(40):
        played = trials.roles[0]
        is_new = play(trials, {"actor": 80.0, "habit": 50.0, "candidate": 0.0}[played])[1] == "rejected"
        candidates += [trials.is_clone] if is_new else []
    assert candidates[:6] == [False, False, True] * 2 and not any(candidates[6:])


def test_noisy_episodes_that_another_actor_began_do_not_count():
    trials = Trials(2, imitated_return=100.0, n_clones=2)
    trials.habit_returns, trials.tests_habit = [10.0, 10.0], False
    trials.on_trial = trials.is_clone = True
    cast(trials, "candidate")
    play(trials, 60.0)
    cast(trials, "candidate")
    assert play(trials, 60.0)[1] == "accepted"
    play(trials, 7.0, env=1)  # begun by the learner of before
    assert trials.noisy_returns == []
    trials.roles[1] = "actor"
    play(trials, 8.0, env=1)
    assert trials.noisy_returns == [8.0]


def test_a_clone_that_is_accepted_late_is_no_candidate_before_it_has_learned_again():
    trials = Trials(1, imitated_return=100.0, n_clones=1)
    assert play_clones(trials, 50.0, 50.0, 0.0, 50.0, has_learned=True)[-2][1] == "rejected"
    assert [verdict for _, verdict, _ in play_clones(trials, 95.0, 95.0, has_learned=True)] == [None, "accepted"]
    assert play_clones(trials, 95.0, 95.0, 95.0, has_learned=False) == [("habit", None, False)] * 3
    assert play_clones(trials, 95.0, 95.0, has_learned=True) == [("candidate", None, False), ("candidate", "tied", False)]


def test_what_the_habit_is_paid_elsewhere_meanwhile_does_not_stop_the_trial_of_a_clone():
    trials = Trials(2, imitated_return=100.0, n_clones=1)
    early = partial(play, trials, has_learned=False)
    for _ in range(2):
        assert early(0.0, 3)[0] == "actor"
        assert early(40.0) == ("habit", None)
    early(0.0, 3, 1)  # its quiet episodes are the clone's
    assert trials.roles == ["actor", "candidate"] and trials.is_clone
    trials.roles[0], trials.quiet = "habit", [QuietEpisode(0, "habit"), *trials.quiet]  # as if it had begun before
    assert early(40.0) == ("habit", None)
    assert early(90.0, env=1) == ("candidate", None)
    assert trials.roles == ["candidate", "candidate"] and not trials.n_clones
    assert early(90.0, env=0) == ("candidate", "accepted")


# ---------------------------------------------------------------------- the agent


class Unpaid(CountingEnv):
    """No verdict can be reached in a few episodes of a few steps."""

    def __init__(self, lengths=(5, 9, 3, 12)):
        super().__init__(lengths=lengths, returns=(0.0,))


def actions_of(model, circuit):
    scaled = circuit.project(model.actor.features(th.as_tensor(OBSERVATIONS))).numpy()
    return model.policy.unscale_action(scaled)


def disturb(circuit, shift=0.05):
    for parameter in circuit.parameters():
        parameter.add_(shift)


def prove(model, *returns):
    """Whole episodes with these returns, however they were played."""
    model.num_timesteps = max(model.num_timesteps, 1)
    for episode_return in returns:
        for step in range(1, PROOF_STEPS + 1):
            is_over = step == PROOF_STEPS
            model._prove(np.array([episode_return if is_over else 0.0]), np.array([is_over]))


def test_predict_is_the_warm_started_clone_until_a_candidate_is_accepted_and_then_the_candidate():
    model = imitating()
    model.pretrain()
    clone = actions_of(model, model.actor.circuit)
    assert np.array_equal(model.predict(OBSERVATIONS)[0], clone)
    model.learn(40)
    assert not np.array_equal(actions_of(model, model.actor.circuit), clone)
    assert np.array_equal(model.predict(OBSERVATIONS)[0], clone)
    model.trials = Trials(1)
    disturb(model.policy.actor_average)
    model._n_updates = model.critic_warmup + 1
    prove(model, 0.0, 1.0, 0.0, 1.0, 0.0)  # noise, the habit, twice, and noise: now the average is frozen as a candidate
    candidate = actions_of(model, model.policy.actor_average)
    disturb(model.policy.actor_average)
    assert np.array_equal(model.predict(OBSERVATIONS)[0], clone)
    prove(model, 2.0)
    assert np.array_equal(model.predict(OBSERVATIONS)[0], clone)
    prove(model, 2.0)
    assert np.array_equal(model.predict(OBSERVATIONS)[0], candidate) and not np.array_equal(candidate, clone)


@pytest.mark.parametrize(
    ("paid", "verdict"),
    [((2.0, 2.0), "accepted"), ((1.0, 1.0), "tied"), ((0.5,), "rejected"), ((2.0,), None), ((0.0, 0.0), None)],
)
def test_the_trust_region_is_resized_by_verdicts_once_something_is_learned(paid, verdict):
    """Where nothing is paid, a tie says nothing."""
    model = imitating(**ONE_CLONE)
    model.pretrain()
    habit_paid = float(any(paid))
    prove(model, *[0.0, habit_paid] * 4)  # before anything is learned: no candidate
    assert model.trials.generation == 0
    model._n_updates = model.critic_warmup + 1
    prove(model, 0.0)  # with noise: the habit is known
    radius = float(model.policy.trust_region.radius)
    prove(model, *paid)
    factor = 1.0 if verdict is None else RADIUS_FACTORS[verdict]
    assert float(model.policy.trust_region.radius) == pytest.approx(factor * radius)


def test_what_is_undecided_leaves_the_trust_region_as_it_is():
    region = make(policy_kwargs={"habit": True}).policy.trust_region
    radius = float(region.radius)
    region.resize("undecided")
    assert float(region.radius) == radius


@pytest.mark.parametrize(("late", "role"), [(0, "habit"), (1, "candidate")])
@pytest.mark.parametrize("begun_at", [0, 100])
def test_a_candidate_is_taken_once_the_critic_has_pressed_long_enough(begun_at, late, role, monkeypatch):
    monkeypatch.setattr(actpc_module, "CANDIDATE_AGE", 7)
    model = imitating(**ONE_CLONE)
    model.pretrain()
    model.trials.begun_at = begun_at  # with a clone that was accepted late
    model._n_updates = max(model.critic_warmup, begun_at) + 7 + late
    prove(model, 0.0, 1.0, 0.0, 1.0, 0.0)
    assert model.trials.roles == [role]


def test_a_clone_that_was_accepted_late_is_not_on_trial_against_itself():
    """In the same breath, where more quiet steps are due: what learns is this clone until the critic has pressed it."""
    trials = Trials(1, imitated_return=100.0, n_clones=1, n_rejected=1, habit_returns=[10.0, 10.0], tests_habit=False)
    play(trials, 0.0, 1000)
    assert trials.is_clone and [play(trials, 95.0, 100)[1] for _ in range(5)] == [None] * 4 + ["accepted"]
    assert trials.roles == ["habit"] and not trials.on_trial


@pytest.mark.parametrize(("paid", "verdict"), [(1.0, "accepted"), (0.0, "rejected")])
def test_a_clone_that_is_accepted_is_where_learning_begins(paid, verdict, monkeypatch):
    """Of other first synapses, trained as the warm start was; about the pressure its verdict says nothing."""
    model = imitating()
    model.learn(30)
    model.trials = Trials(1, imitated_return=1.0, n_clones=3, n_rejected=1)
    before = [weights_of(model.actor.habit), weights_of(model.actor.circuit)]
    region, n_stored = model.policy.trust_region, model.replay_buffer.size()
    radius = float(region.radius)
    region.multiplier.fill_(0.7)
    region.deviation.fill_(0.3)
    model.policy.spread.fill_(7.0)
    updates, update = [], Cloning.update
    monkeypatch.setattr(Cloning, "update", lambda self, index: (updates.append((self.clone, index)), update(self, index)))
    prove(model, 0.0, 0.5, 0.0, 0.5, 0.0)  # noise, the habit, twice, and noise: now a clone is made
    assert [index for _, index in updates] == list(range(20))
    assert n_stored == model.replay_buffer.size() == 30
    clone = weights_of(model.policy.candidate)
    assert not differ(clone, weights_of(updates[-1][0])) and differ(clone, before[0])
    assert not differ(before[1], weights_of(model.actor.circuit)) and model.trials.is_clone and model.trials.n_clones == 2
    prove(model, paid, paid)
    expected = [clone] * 4 if verdict == "accepted" else [before[0], before[1]]
    circuits = model.actor.habit, model.actor.circuit, model.actor_target, model.policy.actor_average
    for circuit, weights in zip(circuits, expected, strict=False):
        assert not differ(weights, weights_of(circuit))
    assert bool(model.actor.circuit.optimizer.state) == (verdict == "rejected")
    assert float(region.radius) == radius
    if verdict == "accepted":
        assert th.allclose(model.policy.spread, spread_of(model._imitation_residuals()), rtol=0.2)  # of other rows
        assert (float(region.multiplier), float(region.deviation)) == (pytest.approx(FIRST_MULTIPLIER), 0.0)
        assert model.trials.begun_at == model._n_updates
    else:
        assert float(region.multiplier) == pytest.approx(0.7) and model.trials.begun_at == 0


@pytest.mark.parametrize("is_clone", [False, True])
def test_a_recalled_habit_acts_again_and_after_a_clone_learning_begins_with_it_again(is_clone):
    """What was learned since goes on where a learner had been accepted; its pressure has lost."""
    model = imitating(**ONE_CLONE)
    model.learn(30)
    region, first = model.policy.trust_region, weights_of(model.actor.habit)
    model.trials = Trials(1, habit_returns=[1.0, 1.0], on_trial=True, is_clone=is_clone, tests_habit=False)
    disturb(model.policy.candidate)
    second, radius = weights_of(model.policy.candidate), float(region.radius)
    cast(model.trials, "candidate")
    model._n_updates = model.critic_warmup + 1
    prove(model, 2.0, 2.0)
    assert not differ(second, weights_of(model.actor.habit)) and not differ(first, weights_of(model.policy.former_habit))
    radius *= 1.0 if is_clone else RADIUS_FACTORS["accepted"]
    disturb(model.actor.circuit)
    learner = weights_of(model.actor.circuit)
    model.trials.tests_habit = True
    cast(model.trials, "habit")
    model.trials.begun_at = -1
    prove(model, -2.0)  # 2/3 in the mean
    assert not differ(first, weights_of(model.actor.habit)) and model.trials.habit_returns == [1.0, 1.0]
    assert not differ(first if is_clone else learner, weights_of(model.actor.circuit))
    assert float(region.radius) == pytest.approx(radius * (1.0 if is_clone else RADIUS_FACTORS["recalled"]))
    assert model.trials.begun_at == (model._n_updates if is_clone else -1)


@pytest.mark.parametrize(
    ("paid", "weighting", "imitated"),
    [
        ((2.0, 1.0), "returns", (16 * 2.0 + 1.0) / 17),
        ((2.0, 1.0), "uniform", 1.5),
        ((0.0, -1.0), "returns", -0.5),  # drawn alike
    ],
)
def test_what_is_imitated_is_paid_as_its_steps_are_drawn(paid, weighting, imitated):
    """Two episodes of five steps; and all the clones but the first may be tried once there is one."""
    data = demonstrations(n_episodes=2, length=5)
    data = dataclasses.replace(data, rewards=np.repeat(paid, 5).astype(np.float32) / 5)
    for updates, n_clones in ((3, 2), (0, 0)):
        settings = {"refresh_kwargs": {"weighting": weighting, "n_clones": 3}, "actor_warm_start": updates}
        model = ActPC("MlpPolicy", CountingEnv(), demonstrations=data, **{**QUICK, **settings})
        model.pretrain()
        assert imitated_return(model.imitation.parts(), weighting) == pytest.approx(imitated)
        assert model.trials.n_clones == n_clones


def test_what_is_imitated_counts_own_episodes_too():
    """As soon as one has ended: the demonstrated ones are paid 1 each, the agent's own of nine steps 3."""
    model = imitating(lambda: CountingEnv(returns=(0.0, 3.0)))
    model.learn(14)  # episodes of five and nine steps
    demonstrated, own = (part.returns for part in model.imitation.parts())
    assert set(own) == {3.0} and len(own) == 9 and set(demonstrated) == {1.0}
    expected = (len(demonstrated) * 1.0 + 9 * 3.0**5) / (len(demonstrated) * 1.0 + 9 * 3.0**4)
    assert model.trials.imitated_return == pytest.approx(expected)


@pytest.mark.parametrize(
    ("paid", "refresh", "takes_all"),
    [
        (1.0, {}, True),
        (0.0, {}, False),
        (1.0, {"weighting": "uniform"}, False),
        (1.0, {"own_episodes": "best"}, False),
    ],
)
def test_every_paid_episode_enters_where_imitation_goes_by_returns(paid, refresh, takes_all):
    """Elsewhere all steps count alike, and the best alone are worth it (the paper)."""
    data = demonstrations(n_episodes=2, length=5)
    data = dataclasses.replace(data, rewards=np.full(10, paid, np.float32))
    model = ActPC("MlpPolicy", CountingEnv(), demonstrations=data, **{**QUICK, "refresh_kwargs": refresh})
    model.learn(60)  # episodes paid 0, 1, 0 and 2 in turn
    memory = model.replay_buffer.self_imitation
    assert memory.takes_all == takes_all
    assert (1.0 in memory.returns[1:]) == takes_all


def test_without_demonstrations_the_best_own_episodes_alone_are_imitated():
    model = ActPC("MlpPolicy", CountingEnv(), **{k: v for k, v in QUICK.items() if k != "actor_warm_start"})
    model.learn(20)
    assert not model.replay_buffer.self_imitation.takes_all


class Roles(BaseCallback):
    """Who played each step."""

    def __init__(self):
        super().__init__()
        self.rows = []

    def _on_step(self):
        self.rows.append(list(self.model.trials.roles))
        return True


@pytest.mark.parametrize("history", [0, 3])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_quiet_episodes_are_exactly_the_habits_or_the_candidates_and_the_others_have_noise(n_envs, history):
    """Both are frozen until a verdict, and here is none: their actions can be worked out afterwards, from the buffer."""
    lengths = [(5, 9, 3, 12), (8, 4, 11)][:n_envs]
    env = DummyVecEnv([lambda one=one: Unpaid(one) for one in lengths])
    model, roles = imitating(env, {"memory_history": history}, **ONE_CLONE), Roles()
    model.learn(240, callback=roles)
    n_rows = 240 // n_envs
    assert model.trials.generation == 0 and len(roles.rows) == n_rows
    rows, envs = (part.ravel() for part in np.mgrid[:n_rows, :n_envs])
    batch = model.inputs.replayed(model.replay_buffer._gather(rows, envs, None), model.reward_weights, model.gamma)
    assert (batch.memory is None) == (history == 0)
    played = np.array([roles.rows[row][env] for row, env in zip(rows, envs, strict=True)])
    for role, circuit in (("habit", model.actor.habit), ("candidate", model.policy.candidate), ("actor", model.actor.circuit)):
        assert (played == role).sum() > 4
        expected = circuit.project(batch.features, batch.memory)[played == role]
        difference = (batch.actions[played == role] - expected).abs().amax(1)
        assert (difference < 1e-6).all() if role != "actor" else (difference > 1e-4).all()
    assert n_envs == 1 or any(one != other for one, other in roles.rows)  # each environment has its own turns


@pytest.mark.parametrize("target_update_interval", [1, 1000])
def test_the_average_follows_the_actor_with_its_rate(target_update_interval):
    """After k updates of a standing actor the share (1 - rate)^k of the distance is left, however seldom targets move."""
    model = imitating(policy_delay=10**6, target_update_interval=target_update_interval)
    model.learn(1)
    disturb(model.policy.actor_average, 1.0)
    model.train(25, 16)
    left = (1.0 - AVERAGING_RATE) ** 25
    for mine, actors in zip(weights_of(model.policy.actor_average), weights_of(model.actor.circuit), strict=True):
        assert th.allclose(mine - actors, th.full_like(mine, left), atol=1e-5)


def test_a_normalised_reward_proves_by_what_was_really_paid():
    model = imitating(VecNormalize(DummyVecEnv([CountingEnv]), norm_obs=False))
    model.learn(240)  # episodes of 5, 9, 3 and 12 steps in turn, paid 0, 1, 0 and 2
    assert {1.0, 2.0} <= set(model.trials.habit_returns) <= {0.0, 1.0, 2.0}
    assert model.trials.noisy_returns and set(model.trials.noisy_returns) <= {0.0, 1.0, 2.0}


def test_another_environment_may_pay_otherwise():
    model = imitating().learn(60)
    assert model.trials.habit_returns
    habit = weights_of(model.actor.habit)
    model.set_env(DummyVecEnv([CountingEnv]))
    assert model.trials == Trials(1, imitated_return=model.trials.imitated_return, n_clones=5)
    assert not differ(habit, weights_of(model.actor.habit))


@pytest.mark.parametrize("force_reset", [True, False])
def test_an_episode_that_goes_on_in_another_environment_counts_for_nothing(tmp_path, force_reset):
    model = imitating().learn(60)
    assert model.trials.lengths == [2], "the second step of an episode"
    model.save(tmp_path / "agent")
    skipped = [] if force_reset else [0]
    assert ActPC.load(tmp_path / "agent", env=DummyVecEnv([CountingEnv]), force_reset=force_reset).trials.skipped == skipped
    model.set_env(model.env, force_reset)
    assert model.trials.skipped == skipped


def test_a_loaded_agent_tries_as_many_clones_as_are_left_and_asked_for(tmp_path):
    model = imitating(refresh_kwargs={"n_clones": 4})
    model.pretrain()
    model.trials.n_clones = 2
    model.save(tmp_path / "agent")
    left = []
    for settings in ({}, ONE_CLONE, {"refresh_kwargs": {"n_clones": 9}}, {"actor_warm_start": 0}):
        again = ActPC.load(tmp_path / "agent", **settings)
        again.set_env(DummyVecEnv([CountingEnv]))
        left.append(again.trials.n_clones)
    assert left == [2, 0, 2, 0]


@pytest.mark.parametrize("by", ["weights", "parameters"])
def test_an_agent_that_was_given_synapses_tries_other_clones_too(by, tmp_path):
    settings = {"refresh_kwargs": {"n_clones": 4}}
    model = imitating(**settings)
    model.pretrain()
    if by == "weights":
        given = {"demonstrations": demonstrations(), "actor_warm_start": 4, **settings}
        again = ActPC.from_weights(model.save_weights(tmp_path / "agent"), model.env, **given)
    else:
        again = imitating(**settings)
        again.set_parameters(model.get_parameters())
    again.learn(2)
    assert again.pretrained
    assert again.trials.n_clones == 3


def test_save_and_load_keep_the_habit_and_how_it_is_pressed(tmp_path):
    model = imitating().learn(60)
    disturb(model.actor.habit)
    disturb(model.policy.candidate, 0.1)
    model.policy.trust_region.multiplier.fill_(0.7)
    model.save(tmp_path / "agent")
    loaded = ActPC.load(tmp_path / "agent", env=DummyVecEnv([CountingEnv]))
    assert np.array_equal(loaded.predict(OBSERVATIONS)[0], model.predict(OBSERVATIONS)[0])
    for name, tensor in model.policy.state_dict().items():
        assert th.equal(loaded.policy.state_dict()[name], tensor), name
    assert loaded.pressure == pytest.approx(0.7)
    # what it was paid is not: the environment may be another
    assert model.trials.habit_returns
    assert loaded.trials == Trials(1, n_clones=model.trials.n_clones, begun_at=model.trials.begun_at)
    elsewhere = partial(CountingEnv, returns=(0.0, 300.0, 0.0, 300.0))
    loaded = ActPC.load(tmp_path / "agent", env=DummyVecEnv([elsewhere] * 2))  # two environments from now on
    loaded.learn(60, reset_num_timesteps=False)
    assert len(loaded.trials.roles) == 2 and set(loaded.trials.habit_returns) == {300.0}


def test_a_file_of_0_2_says_so(tmp_path):
    """Its signals were keywords of the agent, and its policy had no spread."""
    model = imitating()
    model.signal_normalizer = "max"
    model.save(tmp_path / "agent")
    with pytest.raises(ValueError, match=r"agent is of another version of sb3_actpc \(with a keyword signal_normalizer\)"):
        ActPC.load(tmp_path / "agent")
    model = imitating()
    del model.policy._buffers["spread"]
    model.save(tmp_path / "agent")
    with pytest.raises(ValueError, match=r"another version of sb3_actpc \(its policy has other parts\)"):
        ActPC.load(tmp_path / "agent")


def test_a_file_of_another_version_says_so(tmp_path, monkeypatch):
    """Its classes had other places."""
    gone = types.ModuleType("sb3_actpc.gone")
    gone.Old = type("Old", (), {"__module__": gone.__name__, "__qualname__": "Old"})
    with monkeypatch.context() as then:
        then.setitem(sys.modules, gone.__name__, gone)
        model = imitating()
        model.memory_of_old = gone.Old()
        model.save(tmp_path / "agent")
    with pytest.raises(ValueError, match=r"agent is of another version of sb3_actpc \(No module named 'sb3_actpc.gone'\)"):
        ActPC.load(tmp_path / "agent")


def test_an_agent_without_its_environment_acts_by_its_habit(tmp_path):
    model = imitating().learn(20)
    model.save(tmp_path / "agent")
    loaded = ActPC.load(tmp_path / "agent")
    assert np.array_equal(loaded.predict(OBSERVATIONS)[0], model.predict(OBSERVATIONS)[0])


def test_an_episode_that_does_not_end_is_named_once(monkeypatch):
    monkeypatch.setattr(actpc_module, "ENDLESS", 30)
    model = imitating(lambda: CountingEnv(lengths=(10, 1000)))
    with pytest.warns(UserWarning, match="gone on for 30 steps: .* end them with gymnasium.wrappers.TimeLimit") as said:
        model.learn(90)
    assert len([one for one in said if "gone on" in str(one.message)]) == 1


def test_random_actions_prove_nothing():
    """What comes before ``learning_starts`` is nobody's: an episode that begins there counts for nothing either."""
    model, roles = imitating(learning_starts=20), Roles()
    model.learn(43, callback=roles)  # episodes of 5, 9, 3, 12, 5 and 9 steps: the fourth, paid 2, goes on until step 29
    assert [row[0] for row in roles.rows] == ["actor"] * 34 + ["habit"] * 9
    assert (model.trials.noisy_returns, model.trials.habit_returns) == ([0.0], [1.0])


def test_of_several_environments_each_counts_from_its_own_next_episode_on():
    """A random step more makes no episode whole: two environments step at once, the second one in longer episodes."""
    pays = [partial(CountingEnv, lengths=(length,), returns=(float(length),), cut=(True,)) for length in (4, 7)]
    model = imitating(DummyVecEnv(pays), learning_starts=9, gradient_steps=-1)
    model.learn(16)  # five random steps of each, then three
    assert model.trials.lengths == [0, 1] and not model.trials.noisy_returns
    model.learn(8, reset_num_timesteps=False)  # four more
    assert model.trials.lengths == [0, 5] and model.trials.noisy_returns == [4.0]


def test_an_episode_that_was_begun_by_another_habit_counts_for_nothing():
    """Parameters that are given within an episode; the next one counts whole."""
    model = imitating(env=lambda: CountingEnv(lengths=(10,), returns=(10.0,), cut=(True,)))
    model.learn(4)
    model.set_parameters(model.get_parameters())
    model.learn(16, reset_num_timesteps=False)
    assert (model.trials.noisy_returns, model.trials.habit_returns) == ([10.0], [])
    model.learn(10, reset_num_timesteps=False)
    assert (model.trials.noisy_returns, model.trials.habit_returns) == ([10.0], [10.0])


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("n_clones", [1, 4])
def test_a_run_stopped_between_verdicts_is_the_run_never_stopped(n_clones, n_envs, tmp_path, monkeypatch):
    """Demonstrations that were paid more than the task pays have clones tried."""
    monkeypatch.setattr(habit_module, "PROOF_STEPS", 1)  # every few episodes a verdict
    monkeypatch.setattr(habit_module, "MOST_PROOF_STEPS", 1)
    data = demonstrations()
    data = dataclasses.replace(data, rewards=5.0 * data.rewards)
    settings = {"demonstrations": data, "refresh_kwargs": {"n_clones": n_clones}, "buffer_size": 200}
    settings["critic_warmup"] = 5 if n_clones == 1 else 1000  # clones are tried before anything is learned

    def make_agent():
        return imitating(DummyVecEnv([CountingEnv] * n_envs), {"memory_history": 3}, **settings)

    straight = learn_straight(make_agent, tmp_path / "straight", 150)
    resumed = learn_in_two(make_agent, tmp_path / "resumed", 150, stop_at=53)
    assert straight.trials.generation >= 2 and straight.trials.n_clones < max(1, n_clones - 1)
    assert_same(straight, resumed)


def test_a_signal_while_a_clone_is_made_waits_for_it_and_loses_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(habit_module, "PROOF_STEPS", 1)
    data = demonstrations()
    data = dataclasses.replace(data, rewards=5.0 * data.rewards)
    settings = {"demonstrations": data, "critic_warmup": 1000, "buffer_size": 200}
    original, steps, signals = Imitation.clone_into, [], []

    def clone_into(self, circuit, number=0):
        cloning = original(self, circuit, number)
        if number:  # not the warm start
            steps.append(self.agent.num_timesteps)
            if signals:
                os.kill(os.getpid(), signals.pop())
        return cloning

    monkeypatch.setattr(Imitation, "clone_into", clone_into)
    straight = learn_straight(lambda: imitating(**settings), tmp_path / "straight", 120)
    first, n_clones = steps[0], len(steps)
    signals.append(signal.SIGTERM)
    resumed = learn_in_two(lambda: imitating(**settings), tmp_path / "resumed", 120, stop_at=first)
    assert not signals and steps == [*steps[:n_clones], *steps[:n_clones]]  # the clone is made once
    assert_same(straight, resumed)


# ---------------------------------------------------------------------- what comes with it


def test_noise_is_no_wider_than_the_demonstrations_around_the_warm_started_actor(monkeypatch):
    """Actions of one size around an actor that does nothing spread by that size; the least is a fiftieth of the box's half."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(60, 2))

    def do_nothing(cloning, index):
        for parameter in cloning.clone.parameters():
            parameter.zero_()

    monkeypatch.setattr(Cloning, "update", do_nothing)
    for sizes, expected in (((0.05, 0.5), (0.05, 0.1)), ((0.001, 0.08), (0.02, 0.08))):
        data = dataclasses.replace(demonstrations(), actions=2.0 * signs * sizes)  # of a box from -2 to 2
        model = ActPC("MlpPolicy", CountingEnv(), demonstrations=data, **QUICK, exploration_noise=0.1)
        model.pretrain()
        assert model.policy.spread.tolist() == pytest.approx(np.maximum(sizes, 0.02), rel=1e-4)
        assert model._exploration((20_000, 2)).std(0) == pytest.approx(np.array(expected), rel=0.05)


def test_without_a_warm_start_the_noise_is_as_asked_for():
    for keywords in ({}, {"demonstrations": demonstrations()}):
        model = make(exploration_noise=0.3, **keywords)
        assert model._exploration((20_000, 2)).std(0) == pytest.approx([0.3, 0.3], rel=0.05)


@pytest.mark.parametrize(("delay", "expected"), [(1, 7), (2, 3), (3, 2)])
def test_the_actor_learns_once_in_so_many_updates_of_the_critic(delay, expected, monkeypatch):
    updates = {"_update_actor": 0, "_update_critic": 0}
    for name in updates:
        monkeypatch.setattr(ActPC, name, lambda self, batch, name=name: updates.update({name: updates[name] + 1}))
    make(policy_delay=delay, learning_starts=1).learn(8)
    assert updates == {"_update_actor": expected, "_update_critic": 7}


def test_refresh_alone_leaves_the_critic_bit_identical():
    model = make(demonstrations=demonstrations(), actor_pressure=0.0)
    critic, target, actor = (weights_of(part) for part in (model.critic, model.critic_target, model.actor.circuit))
    model.learn(40)
    assert not differ(critic, weights_of(model.critic)) and not differ(target, weights_of(model.critic_target))
    assert differ(actor, weights_of(model.actor.circuit))
