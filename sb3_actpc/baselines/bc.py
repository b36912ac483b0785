"""Behavior cloning, with and without a memory, as Stable-Baselines3 algorithms."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from sb3_actpc.baselines.bc_policies import BCPolicy, BCRNNPolicy, CloningPolicy
from sb3_actpc.baselines.offline_algorithm import OfflineAlgorithm
from sb3_actpc.demonstrations import Demonstrations, scaled_actions
from sb3_actpc.utils.arguments import Positive, Share, Weight, checked


class BC(OfflineAlgorithm):
    """Behavior cloning: the mean squared error between the demonstrated actions (scaled to [-1, 1]) and the network's.

    A step of ``learn`` is one gradient step of every seed. Observations are normalized by the demonstrations' mean and
    standard deviation. Some episodes are held out: the policy is the network, of all seeds and all validations, with the
    smallest error on them (early stopping). Without held-out episodes there is one seed, and the policy is its last network.

    :param args: policy and env of :class:`~sb3_actpc.baselines.offline_algorithm.OfflineAlgorithm`
    :param n_seeds: networks trained side by side
    :param held_out_fraction: share of the episodes to hold out, at least one of several; 0 for none
    :param validation_interval: steps between two validations; ``learn`` ends with one too
    :param weight_decay: decoupled from the gradient (AdamW)
    :param input_noise: standard deviation of Gaussian noise on the normalized observations of each batch
    :param options: further keywords as there; ``policy_kwargs`` takes ``net_arch``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": BCPolicy}
    policy: CloningPolicy

    @checked
    def __init__(
        self,
        *args: Any,
        n_seeds: Positive = 4,
        held_out_fraction: Share = 0.1,
        validation_interval: Positive = 100,
        weight_decay: Weight = 0.0,
        input_noise: Weight = 0.0,
        **options: Any,
    ) -> None:
        self.n_seeds = n_seeds
        self.held_out_fraction = held_out_fraction
        self.validation_interval = validation_interval
        self.weight_decay = weight_decay
        self.input_noise = input_noise
        super().__init__(*args, **options)

    def _network_kwargs(self) -> dict[str, Any]:
        return {"optimizer_kwargs": {"weight_decay": self.weight_decay}}

    def _take(self, demonstrations: Demonstrations) -> None:
        assert isinstance(self.action_space, spaces.Box)
        actions = scaled_actions(demonstrations, self.action_space)
        rows = th.as_tensor(demonstrations.observations, device=self.device)
        self.policy.fit_normalization(rows)
        self._observations, self._actions = self.policy.normalized(rows), th.as_tensor(actions, device=self.device)
        bounds = demonstrations.episode_bounds
        lengths = bounds[:, 1] - bounds[:, 0]
        self._episode_ends = th.as_tensor(np.repeat(bounds[:, 1], lengths), device=self.device)
        held_out = np.zeros(len(bounds), dtype=bool)
        if self.held_out_fraction and len(bounds) > 1:
            n_held_out = min(max(1, round(self.held_out_fraction * len(bounds))), len(bounds) - 1)
            held_out[np.random.permutation(len(bounds))[:n_held_out]] = True
        is_held_out = th.as_tensor(np.repeat(held_out, lengths), device=self.device)
        self._validation_rows = is_held_out.nonzero()[:, 0]
        self._training_rows = (~is_held_out).nonzero()[:, 0]
        self._smallest_error = np.inf
        self._networks = [self.policy]
        if len(self._validation_rows):
            self._networks = [self._new_network() for _ in range(self.n_seeds)]

    def _new_network(self) -> CloningPolicy:
        kwargs = {**self._network_kwargs(), **self.policy_kwargs}
        network = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **kwargs).to(self.device)
        assert isinstance(network, CloningPolicy)
        if self._n_updates:  # of an agent that was loaded, and goes on learning
            network.load_state_dict(self.policy.state_dict())
        network.mean.copy_(self.policy.mean)
        network.spread.copy_(self.policy.spread)
        return network

    def _gradient_step(self) -> dict[str, th.Tensor]:
        losses = []
        for network in self._networks:
            network.set_training_mode(True)
            self._update_learning_rate(network.optimizer)
            drawn = th.randint(len(self._training_rows), (self.batch_size,), device=self.device)
            loss = self._loss(network, self._training_rows[drawn], self.input_noise)
            network.optimizer.zero_grad()
            loss.backward()
            network.optimizer.step()
            losses.append(loss.detach())
        if (self._n_updates + 1) % self.validation_interval == 0:
            self._validate()
        return {"loss": th.stack(losses).mean()}

    def _validate(self) -> None:
        """Make the network with the smallest error so far on the held-out episodes the policy."""
        if not len(self._validation_rows):
            return
        for network in self._networks:
            with th.no_grad():
                error = self._loss(network, self._validation_rows).item()
            if error < self._smallest_error:
                self._smallest_error = error
                self.policy.load_state_dict(network.state_dict())
        self.logger.record("train/held_out_error", self._smallest_error)

    def _loss(self, network: CloningPolicy, rows: th.Tensor, noise: float = 0.0) -> th.Tensor:
        """Mean squared error of a network's actions in (B,) demonstrated rows."""
        return nn.functional.mse_loss(network(self._inputs(rows, noise)), self._actions[rows])

    def _inputs(self, rows: th.Tensor, noise: float) -> th.Tensor:
        """Normalized observations with noise, (*shape, obs_dim), of rows of any shape."""
        inputs = self._observations[rows]
        return inputs + noise * th.randn_like(inputs) if noise else inputs

    def _excluded_save_params(self) -> list[str]:
        own = ["_observations", "_actions", "_episode_ends", "_training_rows", "_validation_rows", "_networks"]
        return [*super()._excluded_save_params(), *own]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []


class BCRNN(BC):
    """Behavior cloning with a recurrent network, in the way of robomimic's BC-RNN (Mandlekar et al., arXiv 2108.03298).

    It learns from sequences that begin anywhere in an episode, with an empty state, and end with it at the latest. When it
    plays, the state begins anew after as many steps, as in robomimic.

    Differences from robomimic:

    1. Mean squared error of the actions, not the likelihood of a Gaussian mixture.
    2. What would lie behind an episode's end is left out of the error, not filled up with its last transition.

    :param args: as :class:`BC`'s
    :param sequence_length: L
    :param carry_state: when it plays, keep the state beyond L steps, through the whole episode
    :param options: further keywords of :class:`BC`; ``policy_kwargs`` are those of
        :class:`~sb3_actpc.baselines.bc_policies.BCRNNPolicy`
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": BCRNNPolicy}

    @checked
    def __init__(self, *args: Any, sequence_length: Positive = 10, carry_state: bool = False, **options: Any) -> None:
        self.sequence_length, self.carry_state = sequence_length, carry_state
        super().__init__(*args, **options)

    def _network_kwargs(self) -> dict[str, Any]:
        return {**super()._network_kwargs(), "restart_every": None if self.carry_state else self.sequence_length}

    def _loss(self, network: CloningPolicy, rows: th.Tensor, noise: float = 0.0) -> th.Tensor:
        """Mean squared error of the actions over the steps, from (B,) rows on, that lie within an episode."""
        steps = rows[:, None] + th.arange(self.sequence_length, device=self.device)
        within = (steps < self._episode_ends[rows][:, None]).float()
        steps = steps.clamp(max=len(self._actions) - 1)
        outputs, _ = network(self._inputs(steps, noise))
        errors = (outputs - self._actions[steps]).square().mean(dim=-1)
        return (errors * within).sum() / within.sum()
