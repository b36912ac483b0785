"""Batches that go from the buffers to the agent."""

from typing import NamedTuple

import numpy as np
import torch as th

Observations = np.ndarray | dict[str, np.ndarray]
TensorObservations = th.Tensor | dict[str, th.Tensor]


class SignalReplaySamples(NamedTuple):
    """
    SB3's replay samples with what ActPC keeps beside them. B transitions, the newest of every environment first.

    :param observations: (B, *obs_shape), or a dict of such
    :param actions: (B, A), scaled to [-1, 1]
    :param next_observations: as ``observations``; with n-step returns those at the end of the n steps
    :param dones: (B, 1), 1 where the episode truly ended (a time limit does not count)
    :param rewards: (B, 1), the task's part alone (normalised or relabelled where asked for)
    :param discounts: (B, 1) with n-step returns, else None
    :param epistemic: (B, 1), the generator's signal, summed over n steps like the rewards
    :param instrumental: (B, 1), the prior's signal, likewise
    :param history: the observations before each transition in its episode, (B, H, *obs_shape), oldest first; None without
        a working memory
    :param history_mask: (B, H), 1 where there was such an observation, or None
    :param following_observations: with n-step returns, those one step on; None where that is ``next_observations``
    :param next_history: with n-step returns and a working memory, the observations before ``next_observations``, as
        ``history``; else None
    :param next_history_mask: likewise
    """

    observations: TensorObservations
    actions: th.Tensor
    next_observations: TensorObservations
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    epistemic: th.Tensor
    instrumental: th.Tensor
    history: TensorObservations | None
    history_mask: th.Tensor | None
    following_observations: TensorObservations | None = None
    next_history: TensorObservations | None = None
    next_history_mask: th.Tensor | None = None


class ImitationSamples(NamedTuple):
    """
    Observations and actions worth imitating, B rows of successful episodes.

    :param observations: (B, *obs_shape) numpy, unnormalised, or a dict of such
    :param actions: (B, A), scaled to [-1, 1]
    :param history: (B, H, *obs_shape), as in :class:`SignalReplaySamples`, or None
    :param history_mask: (B, H) or None
    """

    observations: Observations
    actions: np.ndarray
    history: Observations | None
    history_mask: np.ndarray | None
