"""Replay buffers: combined experience replay, the two internal signals, self-imitation and rebuilt working memory."""

import warnings
from typing import Annotated, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.actpc.batches import Observations, SignalReplaySamples, to_device
from sb3_actpc.actpc.reward_signals import STORED, Normalize
from sb3_actpc.actpc.self_imitation import SelfImitationMemory
from sb3_actpc.utils.arguments import Between, Share, Size, checked
from sb3_actpc.utils.checks import LARGEST_SIZE
from sb3_actpc.utils.nested import map_observations

OWN_TRANSITIONS = 100_000  # that the self-imitation memory keeps, of a buffer that keeps more


class SignalReplay(ReplayBuffer):
    """What all ActPC buffers add to SB3's; combine it with one of them.

    * Combined experience replay (Zhang & Sutton, 2017): the newest transition of every environment is always in the batch;
      where these would be more than half of its rows, of so many environments drawn anew.
    * The epistemic and the instrumental signal of every transition, stored apart from the task's reward.
    * Self-imitation: when an episode ends and is good enough, its rows are copied into a
      :class:`~sb3_actpc.actpc.self_imitation.SelfImitationMemory`.
    * The working memory is not stored: the observations before a transition are gathered when it is sampled.

    :param combined: put the newest transitions into every batch
    :param self_imitation_size: capacity of the self-imitation memory in transitions; 0 for none, None for 100,000, or as many
        as the buffer has where these are fewer
    :param history: H, how many preceding observations come with a transition; 0 for none
    :param n_steps: length of n-step returns
    :param gamma: their discount
    :raises ValueError: naming a value that is not allowed, or two that do not go together
    """

    @checked
    def __init__(
        self,
        *args: Any,
        combined: bool = True,
        self_imitation_size: Annotated[int | None, Between(0, LARGEST_SIZE)] = None,
        history: Annotated[int, Between(0, LARGEST_SIZE)] = 0,
        n_steps: Size = 1,
        gamma: Share = 0.99,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.combined = combined
        self.history = history
        self.set_returns(n_steps, gamma)
        self.epistemic = np.zeros((self.buffer_size, self.n_envs), dtype=np.float32)
        self.instrumental = np.zeros((self.buffer_size, self.n_envs), dtype=np.float32)
        if self_imitation_size is None:
            self_imitation_size = min(OWN_TRANSITIONS, self.buffer_size * self.n_envs)
        self.self_imitation = SelfImitationMemory(self_imitation_size) if self_imitation_size else None
        self.running_lengths = np.zeros(self.n_envs, dtype=np.int64)  # (n_envs,), steps of the running episodes

    # ------------------------------------------------------------------ storing

    def add(
        self, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray, done: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        """As SB3's: store a transition of every environment. Its signals are 0 until :meth:`store_signals`."""
        super().add(obs, next_obs, action, reward, done, infos)
        self.store_signals(0.0, 0.0)
        self.running_lengths += 1
        for env in np.flatnonzero(done):
            self._offer_episode(int(env))
            self.running_lengths[env] = 0

    def store_signals(self, epistemic: np.ndarray | float, instrumental: np.ndarray | float) -> None:
        """Both signals of the newest transitions, (n_envs,) each."""
        self.epistemic[self.newest] = epistemic
        self.instrumental[self.newest] = instrumental

    def _offer_episode(self, env: int) -> None:
        """Copy the episode that has just ended into the self-imitation memory, if it is good enough and all there."""
        length = int(self.running_lengths[env])
        if self.self_imitation is None or length > self.buffer_size - int(self.optimize_memory_usage):
            return
        rows = (self.newest + 1 + np.arange(-length, 0)) % self.buffer_size
        episode_return = float(sum((self.rewards[rows, env] - self.self_imitation.failure_reward).tolist()))
        if self.self_imitation.takes(length, episode_return):
            observations = map_observations(lambda ring: ring[rows, env], self.observations)
            self.self_imitation.store(observations, self.actions[rows, env].astype(np.float32), episode_return)

    @property
    def can_sample(self) -> bool:
        """Whether there is anything to draw."""
        return self.size() > 0

    @property
    def newest(self) -> int:
        """Row of the newest transitions."""
        return (self.pos - 1) % self.buffer_size

    def cut_running_episodes(self) -> None:
        """The environments were reset in mid-episode: nothing bootstraps, sums or remembers across the cut."""
        self.running_lengths[:] = 0
        if self.full or self.pos > 0:
            cut = self.dones[self.newest] == 0
            self.dones[self.newest, cut] = 1.0
            self.timeouts[self.newest, cut] = float(self.handle_timeout_termination)  # as a time limit does

    def reset(self) -> None:
        super().reset()
        self.running_lengths[:] = 0

    def set_returns(self, n_steps: int, gamma: float) -> None:
        """Length and discount of the returns that are sampled; ValueError for several steps where they cannot be had."""
        if n_steps > 1 and (relabels(type(self)) or self.optimize_memory_usage):
            raise ValueError(
                f"n_steps={n_steps} does not work with hindsight relabelling or optimize_memory_usage=True: use 1"
            )
        self.n_steps = n_steps
        self.gamma = gamma

    def forget_own_episodes(self) -> None:
        """Those of the self-imitation memory: in another environment their returns would differ."""
        if self.self_imitation is not None:
            self.self_imitation = SelfImitationMemory(self.self_imitation.capacity)

    # ------------------------------------------------------------------ checkpoints

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint keeps beside the arrays with a row per step: episodes begun and the self-imitation memory."""
        memory = None if self.self_imitation is None else self.self_imitation.checkpoint_state()
        return {"lengths": self.running_lengths.copy(), "self_imitation": memory}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """:param state: what :meth:`checkpoint_state` returned"""
        self.running_lengths[:] = state["lengths"]
        if self.self_imitation is not None and state["self_imitation"] is not None:
            self.self_imitation.restore_checkpoint_state(state["self_imitation"])

    # ------------------------------------------------------------------ sampling

    def n_newest(self, batch_size: int) -> int:
        """How many of ``batch_size`` sampled transitions are those of the last step."""
        return min(self.n_envs, -(-batch_size // 2)) if self.combined else 0

    def sample(  # type: ignore[override]
        self,
        batch_size: int,
        env: VecNormalize | None = None,
        rewards_of: tuple[Normalize, Normalize] | None = STORED,
        n_newest: int | None = None,
    ) -> SignalReplaySamples:
        """:param batch_size: B
        :param env: VecNormalize whose statistics normalise observations and the task's rewards
        :param rewards_of: what stored epistemic and instrumental signals pay, element by element; themselves by default. None
            where nobody asks: the signals are 0, and with n-step returns nothing is gathered one step on
        :param n_newest: how many of the last step; None for :meth:`n_newest` of the batch size
        :return: B transitions; with ``combined``, ``n_newest`` of the last step come first
        """
        newest = np.arange(self.n_newest(batch_size) if n_newest is None else n_newest)
        if 0 < len(newest) < self.n_envs:
            newest = np.random.permutation(self.n_envs)[: len(newest)]
        rows = np.full(len(newest), self.newest)
        envs = newest
        if len(newest) < batch_size:
            drawn_rows, drawn_envs = self._draw(batch_size - len(newest))
            rows = np.concatenate([rows, drawn_rows])
            envs = np.concatenate([envs, drawn_envs])
        return self._relabel(self.gather(rows, envs, env, rewards_of), rows, envs, len(newest), env)

    def _relabel(
        self, batch: SignalReplaySamples, rows: np.ndarray, envs: np.ndarray, n_newest: int, env: VecNormalize | None
    ) -> SignalReplaySamples:
        """What a subclass does to the drawn transitions (all but the first ``n_newest``)."""
        return batch

    def _draw(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """``n`` stored (row, environment) pairs, uniformly."""
        if not self.full:
            return np.random.randint(0, self.pos, size=n), np.random.randint(0, self.n_envs, size=n)
        # a full ring: rows at pos have lost their predecessors (or, memory-optimised, their successor)
        skipped = min(self.history + int(self.optimize_memory_usage), self.buffer_size - 1)
        ages = np.random.randint(skipped, self.buffer_size, size=n)
        return (self.pos + ages) % self.buffer_size, np.random.randint(0, self.n_envs, size=n)

    def gather(
        self,
        rows: np.ndarray,
        envs: np.ndarray,
        env: VecNormalize | None = None,
        rewards_of: tuple[Normalize, Normalize] | None = STORED,
    ) -> SignalReplaySamples:
        """The transitions at (B,) rows and environments; the others as for :meth:`sample`."""
        window, last, mask = self._n_step_window(rows, envs)
        history, history_mask = self._history_at(rows, envs, env)
        next_history, next_history_mask = (
            self._history_at(last, envs, env, including=True) if self.n_steps > 1 else (None, None)
        )
        epistemic = instrumental = np.zeros((len(rows), 1), dtype=np.float32)
        if rewards_of is not None:
            epistemic = self._summed(self.epistemic, window, envs, mask, rewards_of[0])
            instrumental = self._summed(self.instrumental, window, envs, mask, rewards_of[1])
        one_step_on = self.n_steps > 1 and rewards_of is not None
        arrays = dict(
            observations=self._observations_at(rows, envs, env),
            actions=self.actions[rows, envs],
            next_observations=self._next_observations_at(last, envs, env),
            dones=(self.dones[last, envs] * (1 - self.timeouts[last, envs])).reshape(-1, 1),
            rewards=self._summed(self.rewards, window, envs, mask, lambda rewards: self._normalize_reward(rewards, env)),
            discounts=self.gamma ** mask.sum(1, keepdims=True),
            epistemic=epistemic,
            instrumental=instrumental,
            history=history,
            history_mask=history_mask,
            following_observations=self._next_observations_at(rows, envs, env) if one_step_on else None,
            next_history=next_history,
            next_history_mask=next_history_mask,
        )
        return SignalReplaySamples(**to_device(arrays, th.device(self.device)))

    def _observations_at(self, rows: np.ndarray, envs: np.ndarray, env: VecNormalize | None) -> Observations:
        return self._normalize_obs(map_observations(lambda array: array[rows, envs], self.observations), env)

    def _next_observations_at(self, rows: np.ndarray, envs: np.ndarray, env: VecNormalize | None) -> Observations:
        if self.optimize_memory_usage:
            return self._observations_at((rows + 1) % self.buffer_size, envs, env)
        return self._normalize_obs(map_observations(lambda array: array[rows, envs], self.next_observations), env)

    def _history_at(
        self, rows: np.ndarray, envs: np.ndarray, env: VecNormalize | None, including: bool = False
    ) -> tuple[Observations | None, np.ndarray | None]:
        """The ``history`` observations before each row in its episode, (B, H, *obs_shape), oldest first, and which of them
        exist, (B, H); None and None without a history.

        :param including: those before the row's *next* observation: its own is the last of them
        """
        if not self.history:
            return None, None
        steps_back = np.arange(self.history, 0, -1) - int(including)
        # row r - 1 precedes r unless it ended its episode or lies before the first row stored
        age = (rows - self.pos) % self.buffer_size if self.full else rows
        exists = steps_back <= age[:, None]
        earlier = (rows[:, None] - steps_back) % self.buffer_size
        unbroken = exists & ((steps_back == 0) | (self.dones[earlier, envs[:, None]] == 0))
        mask = np.flip(np.logical_and.accumulate(np.flip(unbroken, axis=1), axis=1), axis=1).astype(np.float32)
        return self._observations_at(earlier, envs[:, None], env), mask

    def _n_step_window(self, rows: np.ndarray, envs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The rows of each n-step window, the last that counts, and which do, (B, n_steps), (B,) and (B, n_steps)."""
        window = (rows[:, None] + np.arange(self.n_steps)) % self.buffer_size
        ended = (self.dones[window, envs[:, None]] != 0) | (window == self.newest)
        before = np.cumsum(ended, axis=1) - ended
        mask = (before == 0).astype(np.float32)
        return window, window[np.arange(len(rows)), mask.sum(1).astype(int) - 1], mask

    def _summed(
        self, values: np.ndarray, window: np.ndarray, envs: np.ndarray, mask: np.ndarray, normalize: Normalize
    ) -> np.ndarray:
        """The discounted sum of ``values`` over each window, each normalised first, (B, 1)."""
        normalized = normalize(values[window, envs[:, None]])
        return (normalized * mask * self.gamma ** np.arange(self.n_steps, dtype=np.float32)).sum(1, keepdims=True)


class CombinedReplayBuffer(SignalReplay):
    """ActPC's replay buffer for Box observations; see :class:`SignalReplay`."""


class CombinedNStepReplayBuffer(SignalReplay, NStepReplayBuffer):
    """The same as SB3's n-step class: chosen for ``n_steps`` above 1."""


class CombinedDictReplayBuffer(SignalReplay, DictReplayBuffer):  # type: ignore[misc]
    """ActPC's replay buffer for Dict observations; see :class:`SignalReplay`."""


class CombinedHerReplayBuffer(SignalReplay, HerReplayBuffer):  # type: ignore[misc]
    """Hindsight experience replay with ActPC's signals: relabelling touches the task's reward and the goals alone.

    The newest transitions are real ones; of the rest SB3's ``her_ratio`` is relabelled. Goals of their own episode alone
    would teach the critic that a slow robot is at its goal: what is reached later is then near. So some goals were
    reached elsewhere, by which what was done leads nowhere: three tenths of all, as in HIQL (Park et al., arXiv 2307.11949).

    :param random_goals: share of the relabelled transitions whose goal was reached at any stored step; 0 for SB3's class. By
        default, and with SB3's ``n_sampled_goal`` of 4, a fifth of what is drawn keeps its goal, half has one of its
        episode, and three tenths have one of any. A step that ended its episode has none of these: with another goal it
        would not have
    :raises ValueError: for a share that is not between 0 and 1
    """

    @checked
    def __init__(self, *args: Any, random_goals: Share = 0.375, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.random_goals = random_goals

    @property
    def can_sample(self) -> bool:
        """Whether an episode has ended, so that there is hindsight."""
        return bool(self.ep_length[: self.size()].any())

    def _draw(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        lengths = self.ep_length[: self.size()]  # a ring of a million rows takes a millisecond to look through
        valid = np.flatnonzero(lengths > 0)
        if not len(valid):
            raise RuntimeError(
                "Unable to sample before the end of the first episode. We recommend choosing a value "
                "for learning_starts that is greater than the maximum number of timesteps in the environment."
            )
        rows, envs = np.unravel_index(np.random.choice(valid, size=n), lengths.shape)
        return rows, envs

    def _sample_goals(self, batch_indices: np.ndarray, env_indices: np.ndarray) -> np.ndarray:
        goals = super()._sample_goals(batch_indices, env_indices)
        rows = batch_indices, env_indices
        goes_on = (self.dones[rows] == 0) | (self.timeouts[rows] != 0)
        is_random = goes_on & (np.random.random(len(goals)) < self.random_goals)
        any_rows = np.random.randint(len(goals), size=is_random.sum())  # of the batch, which is drawn from all episodes
        goals[is_random] = self.next_observations["achieved_goal"][batch_indices[any_rows], env_indices[any_rows]]
        return goals

    def cut_running_episodes(self) -> None:
        self.running_lengths[:] = 0
        if (self._current_ep_start != self.pos).any():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # SB3 recommends an option that ``learn`` does not have
                self.truncate_last_trajectory()

    def _relabel(
        self, batch: SignalReplaySamples, rows: np.ndarray, envs: np.ndarray, n_newest: int, env: VecNormalize | None
    ) -> SignalReplaySamples:
        # anywhere among the rows, which are cut into minibatches later
        n_drawn = len(rows) - n_newest
        relabelled = n_newest + np.random.permutation(n_drawn)[: int(self.her_ratio * n_drawn)]
        if not len(relabelled):
            return batch
        assert isinstance(batch.observations, dict) and isinstance(batch.next_observations, dict)
        virtual = self._get_virtual_samples(rows[relabelled], envs[relabelled], env)
        index = th.as_tensor(relabelled, device=self.device)
        for key, value in virtual.observations.items():
            batch.observations[key][index] = value
            batch.next_observations[key][index] = virtual.next_observations[key]
        if isinstance(batch.history, dict):  # the past was lived under another goal: remember it under the new one
            batch.history["desired_goal"][index] = virtual.observations["desired_goal"][:, None]
        batch.rewards[index] = virtual.rewards
        return batch


_COUNTERPARTS: dict[type[ReplayBuffer], type[SignalReplay]] = {
    ReplayBuffer: CombinedReplayBuffer,
    NStepReplayBuffer: CombinedNStepReplayBuffer,
    DictReplayBuffer: CombinedDictReplayBuffer,
    HerReplayBuffer: CombinedHerReplayBuffer,
}
_BY_NAME = {kind.__name__: kind for kind in _COUNTERPARTS}


def relabels(given: Any) -> bool:
    """Whether the class the user asked for, or its name, or None, is one of hindsight."""
    kind = _BY_NAME.get(given) if isinstance(given, str) else given
    return isinstance(kind, type) and issubclass(kind, HerReplayBuffer)


def combined_buffer_class(
    given: type[ReplayBuffer] | str | None, observation_space: spaces.Space, env: VecEnv | None, n_steps: int = 1
) -> type[SignalReplay]:
    """
    ActPC's counterpart of a class of SB3's.

    :param given: a class, its name, or None
    :param observation_space: the environment's
    :param env: the environment; None for an agent that is loaded without one
    :param n_steps: length of the returns
    :raises ValueError: for a class without a counterpart, or for other observations
    """
    has_parts = isinstance(observation_space, spaces.Dict)
    kind: Any = _BY_NAME.get(given, given) if isinstance(given, str) else given
    if kind is None and has_parts:
        kind = DictReplayBuffer
    elif kind is None:
        kind = NStepReplayBuffer if n_steps > 1 else ReplayBuffer
    if isinstance(kind, type):
        kind = _COUNTERPARTS.get(kind, kind)
    if not (isinstance(kind, type) and issubclass(kind, SignalReplay)):
        raise ValueError(f"replay_buffer_class={given!r} must be None, one of {list(_BY_NAME)} or a subclass of ActPC's own")
    if issubclass(kind, DictReplayBuffer) != has_parts:
        raise ValueError(f"replay_buffer_class={given!r} does not keep observations of {observation_space}: leave it out")
    has_goals = isinstance(observation_space, spaces.Dict) and "desired_goal" in observation_space.spaces
    if relabels(kind) and not (has_goals and (env is None or env.has_attr("compute_reward"))):
        raise ValueError(f"replay_buffer_class={given!r} needs a goal environment with compute_reward (GoalEnv)")
    return kind
