"""Replay: combined experience replay, signals kept apart, self-imitation, n-step sums, memory."""

import pickle
import warnings

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

from sb3_actpc.actpc.buffers import CombinedReplayBuffer, combined_buffer_class
from sb3_actpc.actpc.self_imitation import RETURN_EXPONENT, Episodes, SelfImitationMemory, sample_union
from tests.checkpoints.runs import assert_equal

SPACES = (spaces.Box(-1, 1, (2,), np.float64), spaces.Box(-1, 1, (1,), np.float32))


def fill(buffer, steps, n_envs, done_every=7, rng=None):
    rng = rng or np.random.default_rng(0)
    for step in range(steps):
        obs = np.full((n_envs, 2), step) + np.arange(n_envs)[:, None] / 10
        done = np.array([(step + env) % done_every == done_every - 1 for env in range(n_envs)])
        infos = [{"TimeLimit.truncated": bool(d and rng.random() < 0.5)} for d in done]
        buffer.add(obs, obs + 1, rng.uniform(-1, 1, (n_envs, 1)), rng.normal(size=n_envs), done, infos)


@pytest.mark.parametrize("steps", [3, 49, 50, 61])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_every_batch_holds_the_newest_transition_of_every_environment(n_envs, steps):
    buffer = CombinedReplayBuffer(50 * n_envs, *SPACES, n_envs=n_envs, device="cpu")
    fill(buffer, steps, n_envs)
    for _ in range(5):
        batch = buffer.sample(8)
        expected = np.full((n_envs, 2), steps - 1) + np.arange(n_envs)[:, None] / 10
        assert np.allclose(batch.observations[:n_envs].numpy(), expected)
        assert len(batch.observations) == 8


def test_of_many_environments_the_newest_are_half_of_a_batch_and_all_have_their_turn():
    n_envs, steps = 12, 40
    buffer = CombinedReplayBuffer(50 * n_envs, *SPACES, n_envs=n_envs, device="cpu")
    fill(buffer, steps, n_envs)
    assert [buffer.n_newest(size) for size in (1, 8, 24, 100)] == [1, 4, 12, 12]
    seen = [buffer.sample(8).observations.numpy() for _ in range(100)]
    newest = np.concatenate([batch[:4] for batch in seen])
    assert np.allclose(newest[:, 0] - newest[:, 1], 0.0) and newest.min() > steps - 1 - 1e-6
    assert len(np.unique(newest[:, 0].round(1))) == n_envs
    assert all(len(np.unique(batch[:4, 0].round(2))) == 4 for batch in seen)  # no environment twice
    assert np.mean([(batch[4:, 0] < steps - 1).mean() for batch in seen]) > 0.9


def test_without_combined_replay_the_newest_is_not_singled_out():
    buffer = CombinedReplayBuffer(1000, *SPACES, combined=False, device="cpu")
    fill(buffer, 1000, 1)
    assert np.mean([float(buffer.sample(1).observations[0, 0]) == 999 for _ in range(200)]) < 0.1


def test_sampling_is_uniform():
    buffer = CombinedReplayBuffer(20, *SPACES, combined=False, device="cpu")
    fill(buffer, 33, 1)
    seen = np.concatenate([buffer.sample(100).observations[:, 0].numpy() for _ in range(100)]).round().astype(int)
    counts = np.bincount(seen)[13:]
    assert len(counts) == 20 and counts.min() > 400 and counts.max() < 600


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("steps", [30, 75])
def test_n_step_sums_equal_sb3s(n_envs, steps):
    ours = CombinedReplayBuffer(40 * n_envs, *SPACES, n_envs=n_envs, n_steps=3, gamma=0.9, device="cpu")
    theirs = NStepReplayBuffer(40 * n_envs, *SPACES, n_envs=n_envs, n_steps=3, gamma=0.9, device="cpu")
    for buffer in (ours, theirs):
        fill(buffer, steps, n_envs, rng=np.random.default_rng(1))
    rows = np.arange(min(steps, 40))
    for env in range(n_envs):
        one = ours._gather(rows, np.full(len(rows), env), None)
        np.random.seed(0)
        original, np.random.randint = np.random.randint, lambda *a, size, e=env, **k: np.full(size, e)
        try:
            other = theirs._get_samples(rows)
        finally:
            np.random.randint = original
        for field in ("observations", "actions", "next_observations", "dones", "rewards", "discounts"):
            assert np.allclose(getattr(one, field), getattr(other, field), atol=1e-6), field


def test_signals_are_summed_over_the_n_step_window_like_rewards():
    buffer = CombinedReplayBuffer(40, *SPACES, n_steps=3, gamma=0.9, device="cpu")
    for step in range(12):
        obs, nothing = np.zeros((1, 2)), np.zeros(1)
        signals = np.array([step]), np.array([-step])
        buffer.add(obs, obs, np.zeros((1, 1)), nothing, nothing, [{}])
        buffer.store_signals(*signals)
    batch = buffer._gather(np.array([2, 10]), np.zeros(2, int), None)
    assert np.allclose(batch.epistemic.ravel(), [2 + 0.9 * 3 + 0.81 * 4, 10 + 0.9 * 11])
    assert np.allclose(batch.instrumental, -batch.epistemic)


def test_memory_stays_near_sb3s():
    """A million HalfCheetah transitions take at most 1.2 times SB3's memory (counted at a hundredth of the size)."""
    pair = spaces.Box(-np.inf, np.inf, (17,), np.float64), spaces.Box(-1, 1, (6,), np.float32)
    size = [
        sum(value.nbytes for value in vars(kind(10_000, *pair, device="cpu")).values() if isinstance(value, np.ndarray))
        for kind in (CombinedReplayBuffer, ReplayBuffer)
    ]
    assert size[0] <= 1.2 * size[1]


def test_an_unknown_buffer_class_is_named():
    class Mine(ReplayBuffer):
        pass

    with pytest.raises(ValueError, match="Mine does not keep"):
        combined_buffer_class(Mine, SPACES[0])


# ---------------------------------------------------------------------- self-imitation


def offer(memory, length, episode_return):
    taken = memory.takes(length, episode_return)
    if taken:
        memory.store(np.full((length, 2), episode_return), np.zeros((length, 1)), episode_return)
    return taken


def test_an_episode_enters_when_its_return_is_positive_and_at_least_the_best():
    memory = SelfImitationMemory(100)
    assert not offer(memory, 5, 0.0)
    assert not offer(memory, 5, -1.0)
    assert offer(memory, 5, 2.0)
    assert not offer(memory, 5, 1.0)
    assert offer(memory, 5, 2.0)
    assert offer(memory, 5, 3.0)
    assert list(memory.returns) == [2.0, 2.0, 3.0] and memory.best_return == 3.0 and len(memory) == 15


def test_beside_demonstrations_imitated_by_returns_every_paid_episode_enters():
    memory = SelfImitationMemory(8)
    memory.takes_all = True
    assert [offer(memory, 4, paid) for paid in (3.0, 0.0, -1.0, 1.0)] == [True, False, False, True]
    assert not offer(memory, 9, 5.0) and list(memory.returns) == [3.0, 1.0]
    assert list(memory.episodes.weights) == [81.0] * 4 + [1.0] * 4  # and the poor one is seldom imitated


def test_the_oldest_episodes_leave_when_the_memory_is_full():
    memory = SelfImitationMemory(12)
    for episode_return in (1.0, 2.0, 3.0):
        offer(memory, 5, episode_return)
    assert list(memory.returns) == [2.0, 3.0]
    assert set(memory.episodes.observations[:, 0]) == {2.0, 3.0}
    assert not offer(memory, 13, 9.0)


def random_episodes(n, rng, with_keys=False):
    """Observations (or a dict of them), actions and return of n episodes; some returns occur several times."""
    for _ in range(n):
        length = int(rng.integers(1, 9))
        seen, actions = rng.normal(size=(length, 3)).astype(np.float32), rng.normal(size=(length, 2)).astype(np.float32)
        yield {"seen": seen, "goal": -seen} if with_keys else seen, actions, float(rng.integers(1, 6))


@pytest.mark.parametrize("with_keys", [False, True])
@pytest.mark.parametrize("halfway", ["goes on", "is pickled", "is restored"])
def test_the_memory_is_its_last_episodes_laid_end_to_end(halfway, with_keys):
    """After every episode, and as if it had been laid out anew: steps are drawn from it alike."""
    memory, kept = SelfImitationMemory(60), []
    for number, (seen, actions, paid) in enumerate(random_episodes(200, np.random.default_rng(0), with_keys)):
        memory.store(seen, actions, paid)
        kept.append((seen, actions, paid))
        while sum(len(one[1]) for one in kept) > 60:
            kept.pop(0)
        if number == 100 and halfway == "is pickled":
            memory = pickle.loads(pickle.dumps(memory))
        if number == 100 and halfway == "is restored":
            state, memory = memory.checkpoint_state(), SelfImitationMemory(60)
            memory.restore_checkpoint_state(state)
        lengths, returns = [len(one[1]) for one in kept], [one[2] for one in kept]
        assert (memory.lengths, memory.returns) == (lengths, returns)
        assert (len(memory), memory.best_return) == (sum(lengths), max(returns))
        seen = [one[0] for one in kept]
        if with_keys:
            observations = {key: np.concatenate([one[key] for one in seen]) for key in ("seen", "goal")}
        else:
            observations = np.concatenate(seen)
        starts = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
        anew = Episodes(observations, np.concatenate([one[1] for one in kept]), starts, np.repeat(returns, lengths))
        drawn = []
        for episodes in (anew, memory.episodes):
            np.random.seed(number)
            drawn.append([sample_union([episodes], 16, 2, weighting) for weighting in ("returns", "uniform")])
        assert_equal(*drawn, "what is drawn")


@pytest.mark.parametrize(("given", "capacity"), [(None, 20), (0, None), (7, 7), (50, 50)])
def test_the_memory_of_own_episodes_is_no_larger_than_the_buffer_unless_asked_for(given, capacity):
    memory = CombinedReplayBuffer(20, *SPACES, n_envs=2, self_imitation_size=given, device="cpu").self_imitation
    assert capacity is None if memory is None else memory.capacity == capacity
    assert CombinedReplayBuffer(10**6, *SPACES, device="cpu").self_imitation.capacity == 100_000


def test_the_replay_buffer_offers_whole_episodes_of_every_environment():
    buffer = CombinedReplayBuffer(100, *SPACES, n_envs=2, self_imitation_size=50, device="cpu")
    for step in range(6):
        done = np.array([step == 5, step == 3])
        obs = np.full((2, 2), step) + np.array([[0.0], [0.5]])
        buffer.add(obs, obs, np.zeros((2, 1)), np.array([0.0, float(step == 3)]), done, [{}, {}])
    episodes = buffer.self_imitation.episodes
    assert np.array_equal(episodes.observations[:, 0], [0.5, 1.5, 2.5, 3.5]) and len(buffer.self_imitation) == 4


def test_an_episode_is_whole_when_the_ring_wraps_and_left_out_when_the_ring_has_lost_its_start():
    buffer = CombinedReplayBuffer(8, *SPACES, self_imitation_size=50, device="cpu")
    lengths, step = (5, 7, 9), 0
    for length in lengths:
        for index in range(length):
            obs, last = np.full((1, 2), step), index == length - 1
            buffer.add(obs, obs + 1, np.full((1, 1), step / 100), np.array([float(last)]), np.array([last]), [{}])
            step += 1
    episodes = buffer.self_imitation.episodes
    assert episodes.observations[:, 0].tolist() == list(range(12)) and buffer.self_imitation.lengths == [5, 7]
    assert np.allclose(episodes.actions[:, 0], np.arange(12) / 100)


def test_signals_are_stored_with_the_newest_transitions_which_come_back_as_they_were_added():
    buffer = CombinedReplayBuffer(4, *SPACES, n_envs=2, history=2, device="cpu")
    obs, nothing = np.array([[1.0, 2.0], [3.0, 4.0]]), np.zeros(2)
    for step in range(2):
        buffer.add(obs + step, obs + step + 1, np.full((2, 1), 0.25), nothing, nothing, [{}, {}])
        newest = buffer.newest_transitions()
        assert np.array_equal(newest.observations, obs + step) and np.array_equal(newest.next_observations, obs + step + 1)
        buffer.store_signals(newest.observations[:, 0] + 0.5, -newest.next_observations[:, 0])
    assert buffer.epistemic[:2].tolist() == [[1.5, 3.5], [2.5, 4.5]]
    assert buffer.instrumental[:2].tolist() == [[-2.0, -4.0], [-3.0, -5.0]]
    assert (newest.actions == 0.25).all() and newest.history_mask.tolist() == [[0, 1], [0, 1]]
    assert np.array_equal(newest.history[:, 1], obs)


def test_a_restored_memory_remembers_what_was_paid():
    """Else twenty bad episodes after a stop would be taken for all there were."""
    memory, restored = SelfImitationMemory(100), SelfImitationMemory(100)
    memory.takes(3, 1.0)
    restored.restore_checkpoint_state(memory.checkpoint_state())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(30):
            assert not restored.takes(3, -1.0)


def test_a_task_that_pays_negative_rewards_alone_is_warned_of_once():
    memory = SelfImitationMemory(100)
    with pytest.warns(UserWarning, match="all of the first 20 episodes had a negative return") as caught:
        assert not any(memory.takes(5, -1.0) for _ in range(60))
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sparse = SelfImitationMemory(100)
        assert not any(sparse.takes(5, 0.0) for _ in range(60))


def episodes_of(*given: tuple[int, float]) -> Episodes:
    """An episode for each (length, return), its number as the observation."""
    lengths, returns = zip(*given, strict=True)
    numbers = np.repeat(np.arange(len(given), dtype=float), lengths)[:, None]
    starts = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
    return Episodes(numbers, np.zeros((len(numbers), 1)), starts, np.repeat(returns, lengths))


def test_the_union_is_drawn_uniformly():
    parts = [episodes_of((30, 5.0)), episodes_of((0, 0.0), (10, 1.0))]
    share = np.mean([sample_union(parts, 100).observations.mean() for _ in range(200)])
    assert share == pytest.approx(0.25, abs=0.02)


def test_imitation_draws_a_step_by_the_return_of_its_episode():
    """p ∝ length * max(return, 0)^k, over the union of both parts."""
    shown = episodes_of((10, 1.0), (20, 2.0), (30, 0.0))
    own = episodes_of((0, 0.0), (0, 0.0), (0, 0.0), (5, 4.0), (7, 0.0))
    drawn = sample_union([shown, own], 40_000, weighting="returns").observations[:, 0].astype(int)
    expected = np.array([10, 20 * 2.0**RETURN_EXPONENT, 0, 5 * 4.0**RETURN_EXPONENT, 0])
    assert np.bincount(drawn, minlength=5) / 40_000 == pytest.approx(expected / expected.sum(), abs=0.01)


def test_a_rewarded_own_episode_does_not_end_the_imitation_of_demonstrations_without_reward():
    shown, own = episodes_of((30, 0.0)), episodes_of((0, 0.0), (10, 0.01))
    drawn = sample_union([shown, own], 20_000, weighting="returns").observations
    assert drawn.mean() == pytest.approx(0.25, abs=0.02)


def test_with_a_negative_demonstrated_return_imitation_draws_uniformly():
    """A constant added to the rewards would else change what is imitated."""
    shown, own = episodes_of((10, 0.1), (30, -3.0)), episodes_of((0, 0.0), (0, 0.0), (40, 9.0))
    drawn = sample_union([shown, own], 20_000, weighting="returns").observations[:, 0].astype(int)
    assert np.bincount(drawn, minlength=3) / 20_000 == pytest.approx([0.125, 0.375, 0.5], abs=0.02)


@pytest.mark.parametrize("low", [0.0, -5.0])
def test_without_a_positive_return_imitation_draws_uniformly(low):
    drawn = sample_union([episodes_of((10, low), (30, 2 * low))], 20_000, weighting="returns").observations
    assert drawn.mean() == pytest.approx(0.75, abs=0.02)


def test_episode_history_stops_at_the_start_of_the_episode():
    episodes = Episodes(np.arange(6.0)[:, None], np.zeros((6, 1)), np.array([0, 0, 0, 3, 3, 3]), np.zeros(6))
    rows = episodes.take(np.array([1, 4, 3]), history=2)
    assert np.array_equal(rows.history_mask, [[0, 1], [0, 1], [0, 0]])
    assert np.array_equal(rows.history[0, 1], [0.0]) and np.array_equal(rows.history[1, 1], [3.0])
    past, mask = episodes.past(np.array([1, 4, 3]), 2, including=True)
    assert np.array_equal(mask, [[1, 1], [1, 1], [0, 1]])
    assert np.array_equal(past[..., 0] * mask, [[0, 1], [3, 4], [0, 3]])


@pytest.mark.parametrize("n_steps", [1, 3, 9])
@pytest.mark.parametrize("steps", [5, 75])
def test_the_past_of_the_bootstrapped_observation_is_what_came_before_it_in_its_episode(steps, n_steps):
    """The observation of step t holds t, the next one t + 1, so that the past is known from the number alone."""
    n_envs, history, capacity = 2, 4, 40
    buffer = CombinedReplayBuffer(capacity * n_envs, *SPACES, n_envs=n_envs, n_steps=n_steps, history=history, device="cpu")
    fill(buffer, steps, n_envs)
    rows = np.repeat(np.arange(min(steps, capacity)), n_envs)
    envs = np.tile(np.arange(n_envs), len(rows) // n_envs)
    batch = buffer._gather(rows, envs, None)
    if n_steps == 1:
        assert batch.next_history is None  # it is the past, and the present observation
        next_past, next_mask = buffer._history_at(rows, envs, None, including=True)
    else:
        next_past, next_mask = batch.next_history.numpy(), batch.next_history_mask.numpy()
    for row, env in enumerate(envs):
        following = round(float(batch.next_observations[row, 0]) - env / 10)
        oldest = max(steps - capacity, 0)
        start = max((following - 1 + env) // 7 * 7 - env, oldest)  # of the episode that `following` ended or goes on with
        expected = list(range(max(start, following - history), following))
        assert next_mask[row].sum() == len(expected)
        assert next_past[row, history - len(expected) :, 0] == pytest.approx(np.array(expected) + env / 10)
