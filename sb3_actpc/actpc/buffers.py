"""Replay buffers: combined experience replay, the two internal signals, self-imitation and rebuilt working memory."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.actpc.self_imitation import SelfImitationMemory, map_observations
from sb3_actpc.actpc.type_aliases import Observations, SignalReplaySamples, TensorObservations
from sb3_actpc.utils.checks import LARGEST_SIZE, check_kinds, check_range


class _SignalReplay(ReplayBuffer):
    """
    What all ActPC buffers add to SB3's; combine it with one of them.

    * Combined experience replay (Zhang & Sutton, 2017): the newest transition of every environment is always in the batch.
    * The epistemic and the instrumental signal of every transition, stored apart from the task's reward.
    * Self-imitation: a finished episode is offered to :class:`~sb3_actpc.actpc.self_imitation.SelfImitationMemory`.
    * The working memory is not stored: the observations before a transition are gathered when it is sampled.

    :param combined: put the newest transitions into every batch
    :param history: H, how many preceding observations come with a transition; 0 for none
    :param self_imitation_size: capacity of the self-imitation memory in transitions; 0 for none
    :param n_steps: length of n-step returns
    :param gamma: their discount
    :raises ValueError: naming a value that is not allowed, or two that do not go together
    """

    def __init__(
        self,
        *args: Any,
        combined: bool = True,
        history: int = 0,
        self_imitation_size: int = 0,
        n_steps: int = 1,
        gamma: float = 0.99,
        **kwargs: Any,
    ) -> None:
        given = locals()
        check_kinds(given, whole="history self_imitation_size n_steps", numbers="gamma", flags="combined")
        check_range(given, "history self_imitation_size", 0, LARGEST_SIZE)
        check_range(given, "n_steps", 1, LARGEST_SIZE)
        check_range(given, "gamma", 0, 1)
        super().__init__(*args, **kwargs)
        if n_steps > 1 and self.optimize_memory_usage:
            raise ValueError(f"n_steps={n_steps} does not work with optimize_memory_usage=True; use n_steps=1 or leave it out")
        self.combined, self.history, self.n_steps, self.gamma = combined, history, n_steps, gamma
        self.epistemic = np.zeros((self.buffer_size, self.n_envs), dtype=np.float32)
        self.instrumental = np.zeros((self.buffer_size, self.n_envs), dtype=np.float32)
        self.self_imitation = SelfImitationMemory(self_imitation_size) if self_imitation_size else None
        self._running: list[list[tuple[Any, np.ndarray, float]]] = [[] for _ in range(self.n_envs)]

    # ------------------------------------------------------------------ storing

    def add(
        self, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray, done: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        super().add(obs, next_obs, action, reward, done, infos)
        if self.self_imitation is not None:
            self._follow_episodes(obs, action, reward, done)

    def _follow_episodes(self, obs: Observations, action: np.ndarray, reward: np.ndarray, done: np.ndarray) -> None:
        assert self.self_imitation is not None
        action = action.reshape(self.n_envs, self.action_dim)
        for env, steps in enumerate(self._running):
            row = {key: np.array(value[env]) for key, value in obs.items()} if isinstance(obs, dict) else np.array(obs[env])
            steps.append((row, action[env].astype(np.float32), float(reward[env])))
            if done[env]:
                first = steps[0][0]
                observations: Observations
                if isinstance(first, dict):
                    observations = {key: np.stack([step[0][key] for step in steps]) for key in first}
                else:
                    observations = np.stack([step[0] for step in steps])
                self.self_imitation.offer(observations, np.stack([step[1] for step in steps]), sum(s[2] for s in steps))
                steps.clear()

    @property
    def newest(self) -> int:
        """Row of the newest transitions."""
        return (self.pos - 1) % self.buffer_size

    def set_newest_signals(self, epistemic: np.ndarray, instrumental: np.ndarray) -> None:
        """Store the signals, (n_envs,) each, of the transitions added last."""
        self.epistemic[self.newest] = epistemic
        self.instrumental[self.newest] = instrumental

    def cut_running_episodes(self) -> None:
        """The environments were reset in mid-episode: nothing bootstraps, sums or remembers across the cut."""
        for env, steps in enumerate(self._running):
            steps.clear()
            if (self.full or self.pos > 0) and not self.dones[self.newest, env]:
                self.dones[self.newest, env] = 1.0
                self.timeouts[self.newest, env] = float(self.handle_timeout_termination)  # as a time limit does

    def reset(self) -> None:
        super().reset()
        self._running = [[] for _ in range(self.n_envs)]

    # ------------------------------------------------------------------ checkpoints

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint keeps beside the arrays with a row per step: the episodes begun and the self-imitation memory."""
        running = [_joined_steps(steps) for steps in self._running]
        memory = None if self.self_imitation is None else self.self_imitation.checkpoint_state()
        return {"running": running, "self_imitation": memory}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """:param state: what :meth:`checkpoint_state` returned"""
        self._running = [_split_steps(steps) for steps in state["running"]]
        if self.self_imitation is not None and state["self_imitation"] is not None:
            self.self_imitation.restore_checkpoint_state(state["self_imitation"])

    # ------------------------------------------------------------------ sampling

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> SignalReplaySamples:  # type: ignore[override]
        """
        :param batch_size: B
        :param env: VecNormalize whose statistics normalise observations and the task's rewards
        :return: B transitions; with ``combined``, those of the last step (of every environment) come first
        """
        newest = np.arange(min(self.n_envs if self.combined else 0, batch_size))
        rows, envs = self._draw(batch_size - len(newest))
        rows = np.concatenate([np.full(len(newest), self.newest), rows])
        envs = np.concatenate([newest, envs])
        return self._relabel(self._gather(rows, envs, env), rows, envs, len(newest), env)

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

    def _gather(self, rows: np.ndarray, envs: np.ndarray, env: VecNormalize | None) -> SignalReplaySamples:
        last, mask = rows, None
        history, history_mask = self._history_at(rows, envs, env)
        next_history: tuple[Any, Any] = (None, None)
        if self.n_steps > 1:
            last, mask = self._n_step_window(rows, envs)
            next_history = self._history_at(last, envs, env, including=True)
        return SignalReplaySamples(
            observations=self._observations_at(rows, envs, env),
            actions=self.to_torch(self.actions[rows, envs]),
            next_observations=self._next_observations_at(last, envs, env),
            dones=self.to_torch((self.dones[last, envs] * (1 - self.timeouts[last, envs])).reshape(-1, 1)),
            rewards=self.to_torch(
                self._summed(self.rewards, rows, envs, mask, lambda rewards: self._normalize_reward(rewards, env))
            ),
            discounts=None if mask is None else self.to_torch(self.gamma ** mask.sum(1, keepdims=True)),
            epistemic=self.to_torch(self._summed(self.epistemic, rows, envs, mask)),
            instrumental=self.to_torch(self._summed(self.instrumental, rows, envs, mask)),
            history=history,
            history_mask=history_mask,
            following_observations=None if mask is None else self._next_observations_at(rows, envs, env),
            next_history=next_history[0],
            next_history_mask=next_history[1],
        )

    def _observations_at(self, rows: np.ndarray, envs: np.ndarray, env: VecNormalize | None) -> TensorObservations:
        return self._to_tensors(map_observations(lambda array: array[rows, envs], self.observations), env)

    def _next_observations_at(self, rows: np.ndarray, envs: np.ndarray, env: VecNormalize | None) -> TensorObservations:
        if self.optimize_memory_usage:
            return self._observations_at((rows + 1) % self.buffer_size, envs, env)
        return self._to_tensors(map_observations(lambda array: array[rows, envs], self.next_observations), env)

    def _to_tensors(self, observations: Observations, env: VecNormalize | None) -> TensorObservations:
        return map_observations(self.to_torch, self._normalize_obs(observations, env))

    def _history_at(
        self, rows: np.ndarray, envs: np.ndarray, env: VecNormalize | None, including: bool = False
    ) -> tuple[TensorObservations | None, th.Tensor | None]:
        """
        The ``history`` observations before each row in its episode, oldest first, and which of them exist.

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
        shape = (len(rows) * self.history,)
        flat = map_observations(
            lambda array: array[earlier, envs[:, None]].reshape(*shape, *array.shape[2:]), self.observations
        )
        past = map_observations(
            lambda array: array.reshape(len(rows), self.history, *array.shape[1:]), self._to_tensors(flat, env)
        )
        return past, self.to_torch(mask)

    def newest_transitions(self, env: VecNormalize | None = None) -> SignalReplaySamples:
        """The transitions added last, one per environment."""
        n_steps, self.n_steps = self.n_steps, 1
        try:
            return self._gather(np.full(self.n_envs, self.newest), np.arange(self.n_envs), env)
        finally:
            self.n_steps = n_steps

    def _n_step_window(self, rows: np.ndarray, envs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Last row of each n-step window and which of its ``n_steps`` rows count, (B,) and (B, n_steps)."""
        window = (rows[:, None] + np.arange(self.n_steps)) % self.buffer_size
        ended = (self.dones[window, envs[:, None]] != 0) | (window == self.newest)
        before = np.cumsum(ended, axis=1) - ended
        mask = (before == 0).astype(np.float32)
        return window[np.arange(len(rows)), mask.sum(1).astype(int) - 1], mask

    def _summed(
        self,
        values: np.ndarray,
        rows: np.ndarray,
        envs: np.ndarray,
        mask: np.ndarray | None,
        normalize: Callable[[np.ndarray], np.ndarray] = lambda values: values,
    ) -> np.ndarray:
        """``values`` at the rows, or their discounted sum over the n-step window, each normalised first, (B, 1)."""
        if mask is None:
            return normalize(values[rows, envs].reshape(-1, 1))
        window = (rows[:, None] + np.arange(self.n_steps)) % self.buffer_size
        discounts = self.gamma ** np.arange(self.n_steps, dtype=np.float32)
        return (normalize(values[window, envs[:, None]]) * mask * discounts).sum(1, keepdims=True)


class CombinedReplayBuffer(_SignalReplay):
    """ActPC's replay buffer for Box observations; see :class:`_SignalReplay`."""


class CombinedNStepReplayBuffer(_SignalReplay, NStepReplayBuffer):
    """The same as SB3's n-step class: chosen for ``n_steps`` above 1."""


class CombinedDictReplayBuffer(_SignalReplay, DictReplayBuffer):  # type: ignore[misc]
    """ActPC's replay buffer for Dict observations; see :class:`_SignalReplay`."""


class CombinedHerReplayBuffer(_SignalReplay, HerReplayBuffer):  # type: ignore[misc]
    """
    Hindsight experience replay with ActPC's signals: relabelling touches the task's reward and the goals alone.

    The newest transitions are real ones; of the rest SB3's ``her_ratio`` is relabelled.
    """

    def _draw(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        valid = np.flatnonzero(self.ep_length > 0)
        if not len(valid):
            raise RuntimeError(
                "Unable to sample before the end of the first episode. We recommend choosing a value "
                "for learning_starts that is greater than the maximum number of timesteps in the environment."
            )
        rows, envs = np.unravel_index(np.random.choice(valid, size=n), self.ep_length.shape)
        return rows, envs

    def cut_running_episodes(self) -> None:
        for steps in self._running:
            steps.clear()
        if (self._current_ep_start != self.pos).any():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # SB3 recommends an option that ``learn`` does not have
                self.truncate_last_trajectory()

    def _relabel(
        self, batch: SignalReplaySamples, rows: np.ndarray, envs: np.ndarray, n_newest: int, env: VecNormalize | None
    ) -> SignalReplaySamples:
        relabelled = np.arange(n_newest, n_newest + int(self.her_ratio * (len(rows) - n_newest)))
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


def _joined_steps(steps: list[tuple[Any, np.ndarray, float]]) -> dict[str, Any] | None:
    """The steps of an episode as arrays with a row each; None before its first."""
    if not steps:
        return None
    first = steps[0][0]
    if isinstance(first, dict):
        observations: Observations = {key: np.stack([step[0][key] for step in steps]) for key in first}
    else:
        observations = np.stack([step[0] for step in steps])
    return {
        "observations": observations,
        "actions": np.stack([step[1] for step in steps]),
        "rewards": np.array([step[2] for step in steps]),
    }


def _split_steps(joined: dict[str, Any] | None) -> list[tuple[Any, np.ndarray, float]]:
    """The inverse of :func:`_joined_steps`."""
    if joined is None:
        return []
    rewards = joined["rewards"].tolist()
    observations = joined["observations"]
    if isinstance(observations, dict):
        rows: list[Any] = [dict(zip(observations, parts, strict=True)) for parts in zip(*observations.values(), strict=True)]
    else:
        rows = list(observations)
    return list(zip(rows, joined["actions"], rewards, strict=True))


_COUNTERPARTS: dict[type[ReplayBuffer], type[ReplayBuffer]] = {
    ReplayBuffer: CombinedReplayBuffer,
    NStepReplayBuffer: CombinedNStepReplayBuffer,
    DictReplayBuffer: CombinedDictReplayBuffer,
    HerReplayBuffer: CombinedHerReplayBuffer,
}


def combined_buffer_class(
    given: type[ReplayBuffer] | str | None, observation_space: spaces.Space, n_steps: int = 1
) -> type[ReplayBuffer]:
    """
    :param given: the class the user asked for, or its name, or None
    :param observation_space: Dict or not
    :param n_steps: length of n-step returns
    :return: the ActPC buffer that does what ``given`` does
    :raises ValueError: for a class that does not keep ActPC's signals
    """
    if isinstance(given, str):
        if given not in (names := {kind.__name__: kind for kind in _COUNTERPARTS}):
            raise ValueError(f"replay_buffer_class={given!r} is unknown; choose one of {list(names)}")
        given = names[given]
    if given is not None and not (isinstance(given, type) and issubclass(given, ReplayBuffer)):
        raise ValueError(f"replay_buffer_class={given!r} must be None or a subclass of SB3's ReplayBuffer")
    if n_steps > 1 and given is not None and issubclass(given, HerReplayBuffer):
        raise ValueError(f"n_steps={n_steps} does not work with hindsight relabelling; use n_steps=1")
    if given is None and isinstance(observation_space, spaces.Dict):
        return CombinedDictReplayBuffer
    if given is None:
        return CombinedNStepReplayBuffer if n_steps > 1 else CombinedReplayBuffer
    if issubclass(given, _SignalReplay):
        return given
    if given in _COUNTERPARTS:
        return _COUNTERPARTS[given]
    raise ValueError(
        f"replay_buffer_class={given.__name__} does not keep ActPC's signals; pass None, one of "
        f"{[c.__name__ for c in _COUNTERPARTS]} or a subclass of {[c.__name__ for c in set(_COUNTERPARTS.values())]}"
    )
