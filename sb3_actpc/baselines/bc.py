"""Behaviour cloning, with and without a memory, as Stable-Baselines3 algorithms."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from sb3_actpc.baselines.bc_policies import BCPolicy, BCRNNPolicy, CloningPolicy
from sb3_actpc.baselines.offline_algorithm import OfflineAlgorithm
from sb3_actpc.demonstrations import Demonstrations, scaled_actions
from sb3_actpc.utils.arguments import Positive, Weight, checked


class BC(OfflineAlgorithm):
    """Behaviour cloning: the mean squared error between the demonstrated actions (scaled to [-1, 1]) and the network's.

    A step of ``learn`` is one gradient step. Observations are normalised by the demonstrations' mean and standard deviation.

    :param args: policy and env of :class:`~sb3_actpc.baselines.offline_algorithm.OfflineAlgorithm`
    :param weight_decay: decoupled from the gradient (AdamW)
    :param input_noise: standard deviation of Gaussian noise on the normalised observations of each batch
    :param options: further keywords as there; ``policy_kwargs`` takes ``net_arch``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": BCPolicy}
    policy: CloningPolicy

    @checked
    def __init__(self, *args: Any, weight_decay: Weight = 0.0, input_noise: Weight = 0.0, **options: Any) -> None:
        self.weight_decay, self.input_noise = weight_decay, input_noise
        super().__init__(*args, **options)

    def _network_kwargs(self) -> dict[str, Any]:
        return {"optimizer_kwargs": {"weight_decay": self.weight_decay}}

    def _take(self, shown: Demonstrations) -> None:
        assert isinstance(self.action_space, spaces.Box)
        actions = scaled_actions(shown, self.action_space)
        rows = th.as_tensor(shown.observations, device=self.device)
        self.policy.fit_normalization(rows)
        self._observations, self._actions = self.policy.normalized(rows), th.as_tensor(actions, device=self.device)
        bounds = shown.episode_bounds
        self._episode_ends = th.as_tensor(np.repeat(bounds[:, 1], bounds[:, 1] - bounds[:, 0]), device=self.device)

    def _gradient_step(self) -> dict[str, th.Tensor]:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        loss = self._loss(th.randint(len(self._actions), (self.batch_size,), device=self.device))
        self.policy.optimizer.zero_grad()
        loss.backward()
        self.policy.optimizer.step()
        return {"loss": loss.detach()}

    def _loss(self, rows: th.Tensor) -> th.Tensor:
        """Mean squared error of the actions of (B,) demonstrated rows."""
        return nn.functional.mse_loss(self.policy(self._inputs(rows)), self._actions[rows])

    def _inputs(self, rows: th.Tensor) -> th.Tensor:
        """Normalised observations with noise, (*shape, obs_dim), of rows of any shape."""
        inputs = self._observations[rows]
        return inputs + self.input_noise * th.randn_like(inputs) if self.input_noise else inputs

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_observations", "_actions", "_episode_ends"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []


class BCRNN(BC):
    """Behaviour cloning with a recurrent network, in the way of robomimic's BC-RNN (Mandlekar et al., arXiv 2108.03298).

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

    def _loss(self, rows: th.Tensor) -> th.Tensor:
        """Mean squared error of the actions over the steps, from (B,) rows on, that lie within an episode."""
        steps = rows[:, None] + th.arange(self.sequence_length, device=self.device)
        within = (steps < self._episode_ends[rows][:, None]).float()
        steps = steps.clamp(max=len(self._actions) - 1)
        outputs, _ = self.policy(self._inputs(steps))
        errors = (outputs - self._actions[steps]).square().mean(dim=-1)
        return (errors * within).sum() / within.sum()
