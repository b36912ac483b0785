"""Replay: combined experience replay, signals kept apart, self-imitation, n-step sums, memory."""

import warnings

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

from sb3_actpc.actpc.buffers import CombinedReplayBuffer
from sb3_actpc.actpc.self_imitation import RETURN_EXPONENT as K
from sb3_actpc.actpc.self_imitation import Episodes, SelfImitationMemory, failure_reward, sample_union

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
        one = ours.gather(rows, np.full(len(rows), env), None)
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
    batch = buffer.gather(np.array([2, 10]), np.zeros(2, int), None)
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
    assert memory.episodes.cumulative_weights.tolist() == [81, 162, 243, 324, 325, 326, 327, 328]  # the poor one is rare


def test_the_oldest_episodes_leave_when_the_memory_is_full():
    memory = SelfImitationMemory(12)
    for episode_return in (1.0, 2.0, 3.0):
        offer(memory, 5, episode_return)
    assert list(memory.returns) == [2.0, 3.0]
    assert set(memory.episodes.observations[:, 0]) == {2.0, 3.0}
    assert not offer(memory, 13, 9.0)


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


@pytest.mark.parametrize(
    ("episodes", "expected"),
    [
        ([[0.0, 1.0, 0.0]], 0.0),
        ([[-1.0, -1.0, 0.0]], -1.0),
        ([[-1.0, -1.0, 0.0], [-1.0, 0.0], [0.0, 0.0]], -1.0),  # one begins at its goal
        ([[-0.5, 10.0]], -0.5),
        ([[-1.0, -1.0, -1.0]], 0.0),
        ([[-2.0, -1.0, 0.0]], 0.0),
        # penalties are no failures to succeed: at an end or a time limit, for a collision, beside a cost of every step
        ([[0.0, 0.0, -1.0], [0.0, 0.0]], 0.0),
        ([[0.0, -1.0, 0.0]], 0.0),
        ([[1.0, 1.0, -1.0]], 0.0),
        ([[-1.0, -10.0, -1.0], [-1.0, -1.0]], 0.0),
    ],
)
def test_the_reward_of_failure_is_the_smaller_of_two_with_which_episodes_begin(episodes, expected):
    starts = np.cumsum([0, *map(len, episodes[:-1])])
    assert failure_reward(np.concatenate(episodes).astype(np.float32), starts) == expected


def test_stored_returns_count_from_the_reward_of_failure_that_is_told_later():
    memory = SelfImitationMemory(100)
    for length, value in ((3, 1.0), (2, 4.0)):
        memory.store(np.zeros((length, 1)), np.zeros((length, 1)), value)
    memory.count_from(-0.5)
    assert memory.returns == [2.5, 5.0] and memory.best_return == 5.0
    assert memory.episodes.returns.tolist() == [2.5] * 3 + [5.0] * 2
    assert memory.episodes.cumulative_weights == pytest.approx(np.cumsum([2.5**4] * 3 + [5.0**4] * 2))


def episodes_of(*given: tuple[int, float]) -> Episodes:
    """An episode for each (length, return), its number as the observation."""
    lengths, returns = zip(*given, strict=True)
    numbers = np.repeat(np.arange(len(given), dtype=float), lengths)[:, None]
    starts = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
    return Episodes(numbers, np.zeros((len(numbers), 1)), starts, np.repeat(returns, lengths))


@pytest.mark.parametrize(
    ("shown", "own", "weighting", "expected"),
    [
        ([(30, 5.0)], [(10, 1.0)], "uniform", [30, 10]),
        # p ∝ length * max(return, 0)^k, over the union of both parts
        ([(10, 1.0), (20, 2.0), (30, 0.0)], [(5, 4.0), (7, 0.0)], "returns", [10, 20 * 2.0**K, 0, 5 * 4.0**K, 0]),
        # a rewarded own episode does not end the imitation of demonstrations without reward
        ([(30, 0.0)], [(10, 0.01)], "returns", [30, 10]),
        # a constant added to the rewards would else change what is imitated
        ([(10, 0.1), (30, -3.0)], [(40, 9.0)], "returns", [10, 30, 40]),
        ([(10, -5.0), (30, -10.0)], [], "returns", [10, 30]),
    ],
)
def test_imitated_steps_are_drawn_uniformly_or_by_the_return_of_their_episode(shown, own, weighting, expected):
    """Demonstrations and own episodes, each of (length, return)."""
    parts = [episodes_of(*shown), episodes_of(*[(0, 0.0)] * len(shown), *own)]
    drawn = sample_union(parts, 40_000, weighting=weighting).observations[:, 0].astype(int)
    shares = np.bincount(drawn, minlength=len(expected)) / 40_000
    assert shares == pytest.approx(np.array(expected) / np.sum(expected), abs=0.01)


def test_episode_history_stops_at_the_start_of_the_episode():
    episodes = Episodes(np.arange(6.0)[:, None], np.zeros((6, 1)), np.array([0, 0, 0, 3, 3, 3]), np.zeros(6))
    rows = episodes.take(np.array([1, 4, 3]), history=2)
    assert np.array_equal(rows.history_mask, [[0, 1], [0, 1], [0, 0]])
    assert np.array_equal(rows.history[0, 1], [0.0]) and np.array_equal(rows.history[1, 1], [3.0])
    past, mask = episodes.past(np.array([1, 4, 3]), 2, including=True)
    assert np.array_equal(mask, [[1, 1], [1, 1], [0, 1]])
    assert np.array_equal(past[..., 0] * mask, [[0, 1], [3, 4], [0, 3]])
