"""The networks of behaviour cloning: normalised observations in, actions out, with or without a memory."""

from abc import abstractmethod
from typing import Annotated, Any, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_actpc.utils.arguments import Between, Positive, checked

CELLS: dict[str, type[nn.GRU] | type[nn.LSTM]] = {"gru": nn.GRU, "lstm": nn.LSTM}
SMALLEST_SPREAD = 1e-3  # an entry that hardly varies in the demonstrations is not blown up
LARGEST_INPUT = 10.0  # as in SB3's VecNormalize
State = tuple[np.ndarray, ...]  # recurrent, an entry in each array for each environment, as SB3's predict takes and returns it


class CloningPolicy(BasePolicy):
    """What both policies share: the normalisation of observations, the optimiser, and actions cut to [-1, 1] before they are
    given the environment's units. The parameters are SB3's; ValueError for observations that are no Box."""

    mean: th.Tensor
    spread: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        optimizer_class: type[th.optim.Optimizer] = th.optim.AdamW,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        if not isinstance(observation_space, spaces.Box):
            raise ValueError(f"behaviour cloning needs Box observations, found {observation_space}")
        super().__init__(
            observation_space,
            action_space,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            normalize_images=False,
            squash_output=True,  # actions are scaled to [-1, 1]
        )
        self.n_inputs, self.n_outputs = (int(np.prod(space.shape or ())) for space in (observation_space, action_space))
        self.register_buffer("mean", th.zeros(self.n_inputs))
        self.register_buffer("spread", th.ones(self.n_inputs))
        self._build()
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    @abstractmethod
    def _build(self) -> None:
        """Make the network."""

    def fit_normalization(self, rows: th.Tensor) -> None:
        """Entries of these observations, (N, obs_dim), shall get mean 0 and standard deviation 1."""
        self.mean.copy_(rows.mean(dim=0))
        self.spread.copy_(rows.std(dim=0, correction=0).clamp(min=SMALLEST_SPREAD))

    def normalized(self, observations: th.Tensor) -> th.Tensor:
        """Observations (..., obs_dim), normalised."""
        return ((observations - self.mean) / self.spread).clamp(-LARGEST_INPUT, LARGEST_INPUT)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = ("observation_space", "action_space", "optimizer_class", "optimizer_kwargs")
        return {**{name: getattr(self, name) for name in names}, "lr_schedule": self._dummy_schedule}


class BCPolicy(CloningPolicy):
    """A multilayer perceptron; ``net_arch`` are its hidden sizes, by default two of 256, the other keywords
    :class:`CloningPolicy`'s."""

    def __init__(self, *args: Any, net_arch: list[int] | None = None, **kwargs: Any) -> None:
        self.net_arch = [256, 256] if net_arch is None else list(net_arch)
        super().__init__(*args, **kwargs)

    def _build(self) -> None:
        self.network = nn.Sequential(*create_mlp(self.n_inputs, self.n_outputs, self.net_arch, nn.ReLU))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """Actions (B, A), not cut to [-1, 1], from normalised observations (B, obs_dim)."""
        return self.network(inputs)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        return self(self.normalized(observation.float().flatten(1))).clamp(-1, 1)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "net_arch": self.net_arch}


class BCRNNPolicy(CloningPolicy):
    """A recurrent network.

    Its state is a tuple of arrays, as in sb3-contrib's RecurrentPPO: (n_layers, n, hidden_size) of the cells (two for an
    LSTM), and last the steps since it began, (n,).

    The other parameters are :class:`CloningPolicy`'s.

    :param cell: "gru" or "lstm"
    :param hidden_size: units of each layer
    :param n_layers: recurrent layers
    :param restart_every: steps after which the state begins anew, as it does in the sequences that it learned from; None
        carries it through the episode
    :raises ValueError: for a keyword with a value that is not allowed
    """

    @checked
    def __init__(
        self,
        *args: Any,
        cell: Literal["gru", "lstm"] = "gru",
        hidden_size: Positive = 256,
        n_layers: Positive = 1,
        restart_every: Annotated[int | None, Between(1)] = None,
        **kwargs: Any,
    ) -> None:
        self.cell, self.hidden_size, self.n_layers, self.restart_every = cell, hidden_size, n_layers, restart_every
        super().__init__(*args, **kwargs)

    def _build(self) -> None:
        self.memory = CELLS[self.cell](self.n_inputs, self.hidden_size, self.n_layers, batch_first=True)
        self.head = nn.Linear(self.hidden_size, self.n_outputs)

    def forward(
        self, inputs: th.Tensor, hidden: tuple[th.Tensor, ...] | None = None
    ) -> tuple[th.Tensor, tuple[th.Tensor, ...]]:
        """:param inputs: normalised observations, (B, T, obs_dim)
        :param hidden: of the cells, each (n_layers, B, hidden_size); None for zeros
        :return: actions, (B, T, A), not cut to [-1, 1], and the hidden state after the last
        """
        is_lstm = self.cell == "lstm"
        outputs, after = self.memory(inputs, hidden if hidden is None or is_lstm else hidden[0])
        return self.head(outputs), after if is_lstm else (after,)

    def initial_state(self, n: int) -> State:
        """The state before the first step of n episodes side by side."""
        n_parts = 2 if self.cell == "lstm" else 1
        hidden = [np.zeros((self.n_layers, n, self.hidden_size), dtype=np.float32) for _ in range(n_parts)]
        return *hidden, np.zeros(n, dtype=np.int64)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: State | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, State]:
        """As SB3's: actions in the environment's units, and the next state; ``deterministic`` has no effect.

        :param observation: of n environments, or of one
        :param state: what the last call returned; None begins n episodes
        :param episode_start: (n,), true where the state begins anew
        :raises ValueError: when state or ``episode_start`` is not that of n episodes of this network
        """
        self.set_training_mode(False)
        tensor, is_batch = self.obs_to_tensor(observation)
        assert isinstance(tensor, th.Tensor)
        rows = tensor.float().flatten(1)
        n = len(rows)
        begins = np.full(n, state is None) if episode_start is None else np.ravel(episode_start).astype(bool)
        if len(begins) != n:
            raise ValueError(f"episode_start has {len(begins)} entries for {n} observations")
        initial = self.initial_state(n)
        before = initial if state is None else state
        found, wanted = [np.shape(part) for part in before], [np.shape(part) for part in initial]
        if found != wanted:
            raise ValueError(f"state has arrays of shapes {found}: this network's, for {n} observations, have {wanted}")
        *hidden, steps = before
        if self.restart_every is not None:
            begins = begins | (steps >= self.restart_every)
        kept = tuple(
            th.as_tensor(np.where(begins[None, :, None], np.float32(0.0), part), device=self.device) for part in hidden
        )
        with th.no_grad():
            outputs, after = self(self.normalized(rows)[:, None], kept)
        scaled = np.clip(outputs[:, 0].cpu().numpy(), -1, 1).reshape(-1, *(self.action_space.shape or ()))
        actions = np.asarray(self.unscale_action(scaled))
        next_state = *(part.cpu().numpy() for part in after), np.where(begins, 0, steps) + 1
        return actions if is_batch else actions[0], next_state

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """The first step of an episode; :meth:`predict` carries the state."""
        assert isinstance(observation, th.Tensor)
        return self(self.normalized(observation.float().flatten(1))[:, None])[0][:, 0].clamp(-1, 1)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = ("cell", "hidden_size", "n_layers", "restart_every")
        return {**super()._get_constructor_parameters(), **{name: getattr(self, name) for name in names}}
