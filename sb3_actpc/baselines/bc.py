"""Behavior cloning, with and without a memory, as Stable-Baselines3 algorithms, and what all offline baselines share."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs, Schedule
from torch import nn
from typing_extensions import Self

from sb3_actpc.baselines.normalization import NormalizedObservations
from sb3_actpc.demonstrations import Demonstrations, scaled_actions
from sb3_actpc.demonstrations.mixin import LearnsFromDemonstrations
from sb3_actpc.utils.arguments import Positive, Share, Weight, checked

VALIDATION_INTERVAL = 100  # steps; ``learn`` ends with one too


class NormalizingPolicy(BasePolicy):
    """A policy that normalizes observations by the demonstrations' mean and standard deviation, and acts in [-1, 1], which is
    scaled to the environment's units."""

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Box) -> None:
        super().__init__(observation_space, action_space, normalize_images=False, squash_output=True)
        self.normalization = NormalizedObservations(observation_space)
        self.n_inputs, self.n_outputs = self.normalization.features_dim, int(np.prod(action_space.shape or ()))

    def normalized(self, observations: np.ndarray | PyTorchObs) -> th.Tensor:
        """Normalized observations (B, obs_dim), of any shape (B, *shape) or a dict of such."""
        if not isinstance(observations, dict):
            observations = th.as_tensor(observations, dtype=th.float32, device=self.device)
        return self.normalization(observations)

    def save(self, path: str) -> None:
        """:raises ValueError: always, since the agent knows what its policy is made of"""
        raise ValueError(f"a {type(self).__name__} cannot be saved without its agent: use agent.save(path)")


class OfflineAlgorithm(LearnsFromDemonstrations):
    """An algorithm that learns from demonstrations alone.

    A step of ``learn`` is one gradient step on a batch of demonstrations: nothing is done in the environment, which gives the
    spaces and the demonstrations' task. Callbacks are called after each, so that evaluations at intervals work as for any
    other algorithm. Nothing is kept to resume from: a training is short enough to be run again.

    :param policy: "MlpPolicy"; BC and BC-RNN take "MultiInputPolicy" too
    :param env: a task with Box observations, or a Dict of these, and Box actions; for its spaces and for evaluations
    :param learning_rate: of the optimiser, or a schedule
    :param batch_size: B
    :param options: keywords of :class:`~sb3_actpc.demonstrations.mixin.LearnsFromDemonstrations` and of SB3's algorithms
    :raises ValueError: for a keyword with a value that is not allowed, without demonstrations, for demonstrations that do not
        fit the environment, for other spaces, and for VecNormalize(norm_obs=True)
    """

    is_offline: ClassVar[bool] = True  # for those who run any algorithm: its steps do nothing in the environment
    policy: NormalizingPolicy

    @checked
    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None,
        *,
        learning_rate: float | Schedule = 1e-3,
        batch_size: Positive = 256,
        _init_setup_model: bool = True,
        **options: Any,
    ) -> None:
        options |= {"support_multi_env": True, "supported_action_spaces": (spaces.Box,)}
        super().__init__(policy, env, learning_rate=learning_rate, **options)
        self.batch_size = batch_size
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._check_actions()
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self._new_policy()
        if self.env is not None:
            self._load_demonstrations()

    def _new_policy(self) -> Any:
        return self.policy_class(self.observation_space, self.action_space, **self.policy_kwargs).to(self.device)

    @abstractmethod
    def _take(self, demonstrations: Demonstrations) -> None:
        """Learn from these demonstrations, which fit the environment."""

    @abstractmethod
    def _gradient_step(self) -> Mapping[str, float | th.Tensor]:
        """Learn from a batch: the losses, by name."""

    def _validate(self) -> None:
        """Choose what acts from now on; nothing to choose here."""

    def _load_demonstrations(self) -> None:
        if self.demonstrations is None:
            raise ValueError(f"demonstrations=None: {type(self).__name__} learns from demonstrations alone, give some")
        if self.has_normalized_observations:
            raise ValueError(f"VecNormalize(norm_obs=True): {type(self).__name__} normalizes by the demonstrations, use False")
        self._take(self._fitted_demonstrations())

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As SB3's; an agent that was loaded without an environment gets its demonstrations now."""
        super().set_env(env, force_reset)
        self._load_demonstrations()

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1000,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """As SB3's: ``total_timesteps`` are gradient steps, callbacks are called after each, and ``log_interval`` of them
        lie between two lines of the log (None: no log)."""
        name = tb_log_name or type(self).__name__
        total, callback = self._setup_learn(total_timesteps, callback, reset_num_timesteps, name, progress_bar)
        callback.on_training_start(locals(), globals())
        # what callbacks look for after a step of the environment: there is none
        callback.update_locals({"actions": np.empty(0, dtype=np.float32), "infos": [], "dones": np.empty(0, dtype=bool)})
        while self.num_timesteps < total:
            self._update_current_progress_remaining(self.num_timesteps, total)
            losses = self._gradient_step()
            self._n_updates += 1
            self.num_timesteps += 1
            if self._n_updates % 100 == 0:
                self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
                for key, loss in losses.items():
                    self.logger.record(f"train/{key}", float(loss))
            if log_interval is not None and self._n_updates % log_interval == 0:
                self.logger.dump(self.num_timesteps)
            if not callback.on_step():
                break
        self._validate()
        callback.on_training_end()
        return self


class BCPolicy(NormalizingPolicy):
    """A multilayer perceptron.

    :param args: spaces of observations and actions
    :param net_arch: hidden sizes, by default two of 256
    :param optimizer_kwargs: of AdamW, which has no ``weight_decay`` unless given; the algorithm sets its learning rate
    """

    def __init__(self, *args: Any, net_arch: list[int] | None = None, optimizer_kwargs: dict[str, Any] | None = None) -> None:
        super().__init__(*args)
        self._build([256, 256] if net_arch is None else net_arch)
        optimizer_kwargs = {"weight_decay": 0.0, **(optimizer_kwargs or {})}
        self.optimizer = th.optim.AdamW(self.parameters(), **optimizer_kwargs)

    def _build(self, net_arch: list[int]) -> None:
        self.network = nn.Sequential(*create_mlp(self.n_inputs, self.n_outputs, net_arch, nn.ReLU))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """Actions (B, A), not cut to [-1, 1], from normalized observations (B, obs_dim)."""
        return self.network(inputs)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self(self.normalized(observation)).clamp(-1, 1)


class BCRNNPolicy(BCPolicy):
    """A GRU, whose state begins anew after as many steps as the sequences that it learned from have.

    :param args: spaces of observations and actions
    :param hidden_size: H, units of the GRU
    :param restart_every: steps after which the state begins anew
    :raises ValueError: for a keyword with a value that is not allowed
    """

    @checked
    def __init__(self, *args: Any, hidden_size: Positive = 256, restart_every: Positive = 10) -> None:
        self.hidden_size, self.restart_every = hidden_size, restart_every
        super().__init__(*args)

    def _build(self, net_arch: list[int]) -> None:
        self.memory = nn.GRU(self.n_inputs, self.hidden_size, batch_first=True)
        self.head = nn.Linear(self.hidden_size, self.n_outputs)

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """Actions (B, T, A), not cut to [-1, 1], from sequences of normalized observations (B, T, obs_dim)."""
        return self.head(self.memory(inputs)[0])

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """As SB3's; ``deterministic`` has no effect.

        :param observation: of n environments, or of one
        :param state: what the last call returned; None begins n episodes
        :param episode_start: (n,), true where the state begins anew
        :return: actions in the environment's units, and the state: the GRU's, (n, H), and the steps since it began, (n,)
        """
        self.set_training_mode(False)
        rows, is_batch = self.obs_to_tensor(observation)
        inputs = self.normalized(rows)
        n = len(inputs)
        if state is None:
            state = np.zeros((n, self.hidden_size)), np.zeros(n, dtype=np.int64)
        hidden, steps = state
        begins = steps >= self.restart_every
        if episode_start is not None:
            begins = begins | np.ravel(episode_start).astype(bool)
        kept = th.as_tensor(np.where(begins[:, None], 0.0, hidden), dtype=th.float32, device=self.device)
        with th.no_grad():
            outputs, after = self.memory(inputs[:, None], kept[None])
            scaled = self.head(outputs)[:, 0].clamp(-1, 1).cpu().numpy().reshape(-1, *(self.action_space.shape or ()))
        actions = np.asarray(self.unscale_action(scaled))
        return actions if is_batch else actions[0], (after[0].cpu().numpy(), np.where(begins, 0, steps) + 1)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """The first step of an episode; :meth:`predict` carries the state."""
        return self(self.normalized(observation)[:, None])[:, 0].clamp(-1, 1)


class BC(OfflineAlgorithm):
    """Behavior cloning: the mean squared error between the demonstrated actions (scaled to [-1, 1]) and the network's.

    A step of ``learn`` is one gradient step of every seed. Observations are normalized by the demonstrations' mean and
    standard deviation. Some episodes are held out: the policy is the network, of all seeds and all validations, with the
    smallest error on them (early stopping). Without held-out episodes there is one seed, and the policy is its last network.

    :param args: policy and env of :class:`OfflineAlgorithm`
    :param n_seeds: networks trained side by side
    :param held_out_fraction: share of the episodes to hold out, at least one of several; 0 for none
    :param input_noise: standard deviation of Gaussian noise on the normalized observations of each batch
    :param options: further keywords as there; ``policy_kwargs`` are those of :class:`BCPolicy`
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": BCPolicy, "MultiInputPolicy": BCPolicy}
    policy: BCPolicy
    _networks: Sequence[BCPolicy] = ()  # one for each seed, once there are demonstrations

    @checked
    def __init__(
        self,
        *args: Any,
        n_seeds: Positive = 4,
        held_out_fraction: Share = 0.1,
        input_noise: Weight = 0.0,
        **options: Any,
    ) -> None:
        self.n_seeds = n_seeds
        self.held_out_fraction = held_out_fraction
        self.input_noise = input_noise
        super().__init__(*args, **options)

    def _take(self, demonstrations: Demonstrations) -> None:
        assert isinstance(self.action_space, spaces.Box)
        if not self._n_updates:  # a loaded agent keeps its statistics
            self.policy.normalization.fit(demonstrations.observations)
        self._demonstrated = demonstrations.observations
        self._observations = self.policy.normalized(self._demonstrated)
        self._actions = th.as_tensor(scaled_actions(demonstrations, self.action_space), device=self.device)
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
        self._networks = [self._new_policy() for _ in range(self.n_seeds)] if held_out.any() else [self.policy]
        for network in self._networks:
            network.normalization.load_state_dict(self.policy.normalization.state_dict())
        if self._n_updates:  # an agent that was loaded
            self._go_on_from_policy()

    def set_parameters(self, *args: Any, **options: Any) -> None:
        """As in SB3; every network goes on from them."""
        super().set_parameters(*args, **options)
        if self._networks:
            self._go_on_from_policy()

    def _go_on_from_policy(self) -> None:
        self._observations = self.policy.normalized(self._demonstrated)
        for network in self._networks:
            network.load_state_dict(self.policy.state_dict())
        self._smallest_error = np.inf
        self._validate()

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
        if (self._n_updates + 1) % VALIDATION_INTERVAL == 0:
            self._validate()
            if len(self._validation_rows):
                self.logger.record("train/held_out_error", self._smallest_error)
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

    def _loss(self, network: BCPolicy, rows: th.Tensor, noise: float = 0.0) -> th.Tensor:
        """Mean squared error of a network's actions in (B,) demonstrated rows."""
        return nn.functional.mse_loss(network(self._inputs(rows, noise)), self._actions[rows])

    def _inputs(self, rows: th.Tensor, noise: float) -> th.Tensor:
        inputs = self._observations[rows]
        return inputs + noise * th.randn_like(inputs) if noise else inputs

    def _excluded_save_params(self) -> list[str]:
        own = [
            "_demonstrated",
            "_observations",
            "_actions",
            "_episode_ends",
            "_training_rows",
            "_validation_rows",
            "_networks",
        ]
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
    3. A GRU, not an LSTM.

    :param args: as :class:`BC`'s
    :param sequence_length: L
    :param options: further keywords of :class:`BC`; ``policy_kwargs`` are those of :class:`BCRNNPolicy`
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": BCRNNPolicy, "MultiInputPolicy": BCRNNPolicy}

    @checked
    def __init__(
        self, *args: Any, sequence_length: Positive = 10, policy_kwargs: dict[str, Any] | None = None, **options: Any
    ) -> None:
        self.sequence_length = sequence_length
        policy_kwargs = {"restart_every": sequence_length, **(policy_kwargs or {})}
        super().__init__(*args, policy_kwargs=policy_kwargs, **options)

    def _loss(self, network: BCPolicy, rows: th.Tensor, noise: float = 0.0) -> th.Tensor:
        """Mean squared error of the actions over the steps, from (B,) rows on, that lie within an episode."""
        steps = rows[:, None] + th.arange(self.sequence_length, device=self.device)
        within = (steps < self._episode_ends[rows][:, None]).float()
        steps = steps.clamp(max=len(self._actions) - 1)
        errors = (network(self._inputs(steps, noise)) - self._actions[steps]).square().mean(dim=-1)
        return (errors * within).sum() / within.sum()
