"""What the circuits see: normalised features of observations, and the working memory rebuilt from their past."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_actpc.actpc.buffers import SignalReplaySamples
from sb3_actpc.actpc.policies import ActPCActor
from sb3_actpc.actpc.self_imitation import Observations, TensorObservations
from sb3_actpc.actpc.transfer import to_device
from sb3_actpc.utils.nested import map_observations


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

    def first(self, n: int) -> "Batch":
        """The first ``n`` rows, for a circuit with a batch size of its own."""
        return self if n >= len(self.features) else Batch(*(None if column is None else column[:n] for column in self))  # type: ignore[arg-type]

    def minibatch(self, index: int, size: int, n_newest: int = 0) -> "Batch":
        """
        One of several minibatches that were sampled together.

        :param index: which, from 0 on
        :param size: its rows
        :param n_newest: the first rows, which all minibatches share
        :return: the newest rows, then ``size - n_newest`` rows of its own
        """
        start = n_newest + index * (size - n_newest)
        stop = start + size - n_newest
        if not index:
            return self.first(stop)
        rows: list[Any] = [None if column is None else column[start:stop] for column in self]
        if n_newest:
            return self.first(n_newest).join(Batch(*rows))
        return Batch(*rows)

    def join(self, other: "Batch") -> "Batch":
        """These rows, then those of ``other``."""
        pairs: Any = zip(self, other, strict=True)
        columns: list[Any] = [None if mine is None else th.cat([mine, theirs]) for mine, theirs in pairs]
        return Batch(*columns)

    def shuffled(self, keep: int) -> "Batch":
        """The first ``keep`` rows as they are, the others in random order."""
        order = th.arange(len(self.features), device=self.features.device)
        order[keep:] = keep + th.randperm(max(len(order) - keep, 0), device=order.device)
        columns: list[Any] = [None if column is None else column[order] for column in self]
        return Batch(*columns)


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
    n_replayed = n_newest + (len(replayed.features) - n_newest) // n_batches
    n_demonstrated = 0 if demonstrated is None else len(demonstrated.features) // n_batches
    for index in range(n_batches):
        batch = replayed.minibatch(index, n_replayed, n_newest)
        if demonstrated is not None:
            batch = batch.join(demonstrated.minibatch(index, n_demonstrated))
        yield batch.shuffled(keep=n_newest) if is_shuffled else batch


class CircuitInputs:
    """:param actor: its extractor, normaliser and working memory are every circuit's
    :param vec_normalize: the VecNormalize wrapper of the training environment, or None
    """

    def __init__(self, actor: ActPCActor, vec_normalize: VecNormalize | None) -> None:
        self.actor, self.vec_normalize = actor, vec_normalize

    @property
    def are_normalised(self) -> bool:
        """Whether VecNormalize does; at first it knows nothing of what it will make of the demonstrations."""
        return self.vec_normalize is not None and bool(self.vec_normalize.norm_obs)

    @property
    def device(self) -> th.device:
        """The agent's."""
        return self.actor.normalizer.mean.device

    def tensor(self, array: np.ndarray) -> th.Tensor:
        """The array as float32 on the agent's device."""
        return th.as_tensor(array, dtype=th.float32, device=self.device)

    def normalized(self, observations: Any, batch_dims: int = 1) -> Observations:
        """:param observations: numpy, as the environment gave them, with ``batch_dims`` leading dimensions; or a dict of such
        :return: numpy, normalised as the replay buffer's are
        """
        if self.vec_normalize is None:
            return observations
        shape = next(iter(observations.values())).shape if isinstance(observations, dict) else observations.shape
        lead = shape[:batch_dims]
        flat = map_observations(lambda array: array.reshape(-1, *array.shape[batch_dims:]), observations)
        normalized = self.vec_normalize.normalize_obs(flat)
        return map_observations(lambda array: array.reshape(*lead, *array.shape[1:]), normalized)

    def observations(self, observations: Any, batch_dims: int = 1) -> TensorObservations:
        """:meth:`normalized`, as tensors."""
        return to_device(self.normalized(observations, batch_dims), self.device)

    def past(
        self, history: Observations | None, mask: np.ndarray | None
    ) -> tuple[TensorObservations | None, th.Tensor | None]:
        """Both as :meth:`memory` takes them, from numpy: (B, H, *obs_shape) as the environment gave them, or a dict of such,
        and (B, H); or None."""
        if history is None or mask is None:
            return None, None
        return self.observations(history, batch_dims=2), self.tensor(mask)

    def features(self, observations: TensorObservations) -> th.Tensor:
        """(B, n_features) of a batch of observations."""
        return self.actor.features(observations)

    def past_features(self, history: TensorObservations | None, mask: th.Tensor | None) -> th.Tensor | None:
        """:param history: (B, H, *obs_shape), the observations before each row, oldest first; or None
        :param mask: (B, H), 1 where there was one in the same episode; or None
        :return: (B, H, n_features), zero before the episode's start; None without a history
        """
        if history is None or mask is None:
            return None
        flat = map_observations(lambda tensor: tensor.flatten(0, 1), history)
        features = self.features(flat)
        return features.view(*mask.shape, features.shape[1]) * mask[:, :, None]

    def memory(self, history: TensorObservations | None, mask: th.Tensor | None) -> th.Tensor | None:
        """m_t, (B, n_memory), or None without a working memory; for the parameters see :meth:`past_features`."""
        past = self.past_features(history, mask)
        return None if past is None or self.actor.memory is None else self.actor.memory(past)

    def memories(
        self,
        history: TensorObservations | None,
        mask: th.Tensor | None,
        features: th.Tensor,
        next_history: TensorObservations | None = None,
        next_mask: th.Tensor | None = None,
    ) -> tuple[th.Tensor | None, th.Tensor | None]:
        """m_t and m_{t+1} (or m_{t+n}), (B, n_memory) each, or None and None without a working memory.

        :param history: as for :meth:`past_features`, like the three other parts of a past
        :param features: (B, n_features) of the present observations, the newest of the past one step on
        :param next_history: with returns of several steps, the past of the observation n steps on
        """
        past = self.past_features(history, mask)
        if past is None or self.actor.memory is None:
            return None, None
        following = self.past_features(next_history, next_mask)
        if following is None:
            following = th.cat([past[:, 1:], features[:, None]], dim=1)
        return self.actor.memory(past), self.actor.memory(following)

    def replayed(self, samples: SignalReplaySamples, weights: tuple[float, float, float], gamma: float) -> Batch:
        """The transitions that the replay buffer drew, as the circuits see them; ``weights`` are (α_ext, α_ep, α_in),
        ``gamma`` discounts one step."""
        features = self.features(samples.observations)
        pasts = samples.history, samples.history_mask, features, samples.next_history, samples.next_history_mask
        memory, next_memory = self.memories(*pasts)
        next_features = bootstrap_features = self.features(samples.next_observations)
        if weights[1] and samples.following_observations is not None:
            next_features = self.features(samples.following_observations)
        return Batch(
            features=features,
            actions=samples.actions,
            next_features=next_features,
            bootstrap_features=bootstrap_features,
            memory=memory,
            next_memory=next_memory,
            rewards=weights[0] * samples.rewards + (weights[1] * samples.epistemic + weights[2] * samples.instrumental),
            dones=samples.dones,
            discounts=th.full_like(samples.dones, gamma) if samples.discounts is None else samples.discounts,
        )
