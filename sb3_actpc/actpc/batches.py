"""Transitions on their way to the circuits: as they are sampled, as the circuits see them, and in minibatches."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize
from torch.utils._pytree import tree_map

from sb3_actpc.actpc.policies import ActPCActor
from sb3_actpc.utils.nested import map_observations

Observations = np.ndarray | dict[str, np.ndarray]
TensorObservations = th.Tensor | dict[str, th.Tensor]


class SignalReplaySamples(NamedTuple):
    """SB3's replay samples with what ActPC keeps beside them. B transitions, the newest of every environment first.

    :param observations: (B, *obs_shape), or a dict of such
    :param actions: (B, A), scaled to [-1, 1]
    :param next_observations: as ``observations``; with n-step returns those at the end of the n steps
    :param dones: (B, 1), 1 where the episode truly ended (a time limit does not count)
    :param rewards: (B, 1), the task's part alone (normalised or relabelled where asked for)
    :param discounts: (B, 1), γ^n
    :param epistemic: (B, 1), the generator's signal, summed over n steps like the rewards
    :param instrumental: (B, 1), the prior's signal, likewise
    :param history: the observations before each transition in its episode, (B, H, *obs_shape), oldest first; None without
        a working memory
    :param history_mask: (B, H), 1 where there was such an observation, or None
    :param following_observations: with n-step returns, those one step on, where somebody asks; else None
    :param next_history: with n-step returns and a working memory, the observations before ``next_observations``, as
        ``history``; else None
    :param next_history_mask: likewise
    """

    observations: TensorObservations
    actions: th.Tensor
    next_observations: TensorObservations
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor
    epistemic: th.Tensor
    instrumental: th.Tensor
    history: TensorObservations | None
    history_mask: th.Tensor | None
    following_observations: TensorObservations | None = None
    next_history: TensorObservations | None = None
    next_history_mask: th.Tensor | None = None


class Batch(NamedTuple):
    """Transitions as the circuits see them, B rows, the newest first, demonstrations (if mixed in) last; where circuits
    have batches of different sizes, all but the newest in any order.

    :param features: normalised observations, (B, n_features)
    :param actions: (B, A), in [-1, 1]
    :param next_features: one step on, which generator and prior predict, (B, n_features); with n-step returns and no weight
        of the epistemic signal nobody predicts it, and it is ``bootstrap_features``
    :param bootstrap_features: where the critic's target is bootstrapped: one step on, or n, (B, n_features)
    :param memory: m_t, (B, n_memory), or None
    :param next_memory: the memory where the target is bootstrapped, m_{t+1} or m_{t+n}, (B, n_memory), or None
    :param rewards: the combined reward r_t, (B, 1)
    :param dones: 1 where the episode truly ended, (B, 1)
    :param discounts: γ, or γ^n with n-step returns, (B, 1)
    """

    features: th.Tensor
    actions: th.Tensor
    next_features: th.Tensor
    bootstrap_features: th.Tensor
    memory: th.Tensor | None
    next_memory: th.Tensor | None
    rewards: th.Tensor
    dones: th.Tensor
    discounts: th.Tensor

    @classmethod
    def of(cls, samples: SignalReplaySamples, rewards: th.Tensor, actor: ActPCActor) -> "Batch":
        """
        :param samples: transitions of the replay buffer, or demonstrated ones
        :param rewards: the combined reward, (B, 1)
        :param actor: its extractor, normaliser and working memory are every circuit's
        """
        features = actor.features(samples.observations)
        next_features = bootstrap_features = actor.features(samples.next_observations)
        if samples.following_observations is not None:
            next_features = actor.features(samples.following_observations)
        memory = next_memory = None
        past = actor.past_features(samples.history, samples.history_mask)
        if past is not None and actor.memory is not None:
            next_past = actor.past_features(samples.next_history, samples.next_history_mask)
            if next_past is None:  # one step on, the present observation is the newest of the past
                next_past = th.cat([past[:, 1:], features[:, None]], dim=1)
            memory = actor.memory(past)
            next_memory = actor.memory(next_past)
        observed = features, samples.actions, next_features, bootstrap_features
        return cls(*observed, memory, next_memory, rewards, samples.dones, samples.discounts)

    def rows(self, index: slice | th.Tensor) -> "Batch":
        """Some of the rows."""
        return Batch(*(None if column is None else column[index] for column in self))  # type: ignore[arg-type]

    def first(self, n: int) -> "Batch":
        """The first ``n`` rows, for a circuit with a batch size of its own."""
        return self if n >= len(self.features) else self.rows(slice(n))


def minibatches(
    replayed: Batch, demonstrated: Batch | None, n_batches: int, n_newest: int, is_shuffled: bool
) -> Iterator[Batch]:
    """
    Minibatches of transitions that were sampled together: the newest in each, then replayed ones, then demonstrated ones.

    :param replayed: the ``n_newest`` newest transitions, then those of all minibatches
    :param demonstrated: those of all minibatches, or None
    :param n_batches: how many
    :param n_newest: rows that all minibatches share
    :param is_shuffled: whether all but the newest rows come in random order
    """
    everything = replayed
    n_demonstrated = 0
    if demonstrated is not None:
        n_demonstrated = len(demonstrated.features)
        pairs: Any = zip(replayed, demonstrated, strict=True)
        columns: Any = [None if mine is None else th.cat([mine, theirs]) for mine, theirs in pairs]
        everything = Batch(*columns)
    rows = th.arange(len(everything.features), device=replayed.features.device)
    newest, own, shown = rows.split([n_newest, len(replayed.features) - n_newest, n_demonstrated])
    for index in range(n_batches):
        parts = (part[index * len(part) // n_batches : (index + 1) * len(part) // n_batches] for part in (own, shown))
        order = th.cat([newest, *parts])
        if is_shuffled:
            rest = order[n_newest:]
            order[n_newest:] = rest[th.randperm(len(rest), device=rest.device)]
        yield everything.rows(order)


def last_observations(
    observations: Observations, dones: np.ndarray, infos: list[dict[str, Any]], env: VecNormalize | None
) -> Observations:
    """What each step led to: ``observations``, where an episode ended its last one instead of the next episode's first."""
    last: Any = map_observations(np.array, observations)
    for index in np.flatnonzero(dones):
        terminal: Any = infos[index].get("terminal_observation")
        if terminal is None:
            continue
        if env is not None:
            terminal = env.unnormalize_obs(terminal)
        parts = [(last[key], terminal[key]) for key in last] if isinstance(last, dict) else [(last, terminal)]
        for array, value in parts:
            array[index] = np.rint(value) if array.dtype.kind in "iu" else value
    return last


def normalized(observations: Observations | None, env: VecNormalize | None) -> Any:
    """Observations, (..., *obs_shape) or a dict of such, as VecNormalize normalises them, if there is one; None stays None."""
    return observations if observations is None or env is None else env.normalize_obs(observations)


def to_device(arrays: Any, device: th.device) -> Any:
    """
    Arrays as tensors.

    :param arrays: arrays and Nones in (named) tuples and dicts
    :param device: where the tensors are; on the CPU they share the arrays' memory
    :return: the same, of tensors
    """
    return tree_map(lambda array: None if array is None else th.as_tensor(array, device=device), arrays)
