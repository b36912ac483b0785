"""Behaviour cloning, with and without a memory, as Stable-Baselines3 algorithms."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from torch import nn

from sb3_actpc.baselines.bc_policies import BCPolicy, BCRNNPolicy, CloningPolicy
from sb3_actpc.baselines.keywords import with_keywords_of
from sb3_actpc.common.checks import check_kinds, check_range
from sb3_actpc.common.demonstration_buffers import fit_demonstrations
from sb3_actpc.common.demonstrations import Demonstrations
from sb3_actpc.common.episodes import Episodes

SelfBC = TypeVar("SelfBC", bound="BC")


class BC(BaseAlgorithm):
    """
    Behaviour cloning: the mean squared error between the demonstrated actions (scaled to [-1, 1]) and the network's.

    A step of ``learn`` is one gradient step on a batch of demonstrations: nothing is done in the environment, which gives the
    spaces and the demonstrations' task. Callbacks are called after each, so that evaluations at intervals work as for any
    other algorithm. Observations are normalised by the demonstrations' mean and standard deviation. Nothing is kept to
    resume from: a training is short enough to be run again.

    :param policy: "MlpPolicy"
    :param env: a task with Box observations and actions; for its spaces and for evaluations
    :param demonstrations: a path, or a :class:`~sb3_actpc.common.demonstrations.Demonstrations`
    :param n_demonstrations: use only the first so many episodes of them
    :param n_demonstration_transitions: use only the first so many transitions
    :param learning_rate: Adam's, or a schedule
    :param batch_size: B
    :param weight_decay: decoupled from the gradient (AdamW)
    :param input_noise: standard deviation of Gaussian noise on the normalised observations of each batch
    :param policy_kwargs: ``net_arch``
    :param stats_window_size: as SB3's
    :param tensorboard_log: as SB3's
    :param verbose: as SB3's
    :param seed: as SB3's
    :param device: as SB3's
    :raises ValueError: for a keyword with a value that is not allowed, without demonstrations, for demonstrations that do not
        fit the environment, for other spaces, and for an environment that normalises observations
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": BCPolicy}
    policy: CloningPolicy

    def __init__(
        self,
        policy: str | type[CloningPolicy],
        env: GymEnv | str | None,
        *,
        demonstrations: Demonstrations | str | Path | None = None,
        n_demonstrations: int | None = None,
        n_demonstration_transitions: int | None = None,
        learning_rate: float | Schedule = 1e-3,
        batch_size: int = 256,
        weight_decay: float = 0.0,
        input_noise: float = 0.0,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        check_kinds(locals(), whole="batch_size", numbers="weight_decay input_noise")
        check_range(locals(), "batch_size", 1)
        check_range(locals(), "weight_decay input_noise", 0)
        super().__init__(
            policy,
            env,
            learning_rate,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            support_multi_env=True,
            supported_action_spaces=(spaces.Box,),
        )
        # a path is kept absolute, so that the saved agent finds its demonstrations from any folder
        self.demonstrations = Path(demonstrations).absolute() if isinstance(demonstrations, (str, Path)) else demonstrations
        self.n_demonstrations, self.n_demonstration_transitions = n_demonstrations, n_demonstration_transitions
        self.batch_size, self.weight_decay, self.input_noise = batch_size, weight_decay, input_noise
        self._n_updates = 0
        if _init_setup_model:
            self._setup_model()

    # ------------------------------------------------------------------ setting up

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        kwargs = {"optimizer_kwargs": {"weight_decay": self.weight_decay}, **self._network_kwargs(), **self.policy_kwargs}
        self.policy = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **kwargs).to(self.device)  # type: ignore[assignment]
        self._observations: th.Tensor | None = None
        if self.env is not None:
            self._load_demonstrations()

    def _network_kwargs(self) -> dict[str, Any]:
        """Keywords of the policy that follow from the algorithm's."""
        return {}

    def _load_demonstrations(self) -> None:
        if self.demonstrations is None:
            raise ValueError(f"demonstrations=None: {type(self).__name__} learns from nothing else, pass a file")
        if self.get_vec_normalize_env() is not None:
            raise ValueError(f"{type(self).__name__} normalises observations itself: leave VecNormalize out")
        limits = self.n_demonstrations, self.n_demonstration_transitions
        shown = fit_demonstrations(self.demonstrations, self.env, self.observation_space, self.action_space, *limits)
        assert isinstance(self.action_space, spaces.Box)
        actions = Episodes.from_demonstrations(shown, self.observation_space, self.action_space).actions
        rows = th.as_tensor(shown.observations, device=self.device)
        self.policy.fit_normalization(rows)
        self._observations, self._actions = self.policy.normalized(rows), th.as_tensor(actions, device=self.device)
        bounds = shown.episode_bounds
        self._episode_ends = th.as_tensor(np.repeat(bounds[:, 1], bounds[:, 1] - bounds[:, 0]), device=self.device)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        :param env: as SB3's; an agent that was loaded without one gets its demonstrations now
        :param force_reset: as SB3's
        """
        super().set_env(env, force_reset)
        self._load_demonstrations()

    # ------------------------------------------------------------------ learning

    def learn(
        self: SelfBC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1000,
        tb_log_name: str = "BC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfBC:
        """
        :param total_timesteps: gradient steps
        :param callback: called after each of them
        :param log_interval: gradient steps between two lines of the log
        :param tb_log_name: as SB3's
        :param reset_num_timesteps: as SB3's
        :param progress_bar: as SB3's
        :return: the agent
        """
        if self._observations is None:
            raise ValueError(f"{type(self).__name__} was loaded without an environment: set_env() first")
        total, callback = self._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total:
            self._update_current_progress_remaining(self.num_timesteps, total)
            self.train()
            self.num_timesteps += 1
            if self._n_updates % log_interval == 0:
                self.logger.dump(self.num_timesteps)
            if not self._step_callback(callback):
                break
        callback.on_training_end()
        return self

    def train(self) -> None:
        """One gradient step."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        loss = self._loss(th.randint(len(self._actions), (self.batch_size,), device=self.device))
        self.policy.optimizer.zero_grad()
        loss.backward()
        self.policy.optimizer.step()
        self._n_updates += 1
        if self._n_updates % 100 == 0:
            self.logger.record("train/loss", loss.item())
            self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _loss(self, rows: th.Tensor) -> th.Tensor:
        """
        :param rows: (B,) of the demonstrations
        :return: mean squared error of the actions
        """
        return nn.functional.mse_loss(self.policy(self._inputs(rows)), self._actions[rows])

    def _inputs(self, rows: th.Tensor) -> th.Tensor:
        """
        :param rows: of the demonstrations, any shape
        :return: (*shape, obs_dim), normalised observations with noise
        """
        assert self._observations is not None
        inputs = self._observations[rows]
        return inputs + self.input_noise * th.randn_like(inputs) if self.input_noise else inputs

    def _step_callback(self, callback: BaseCallback) -> bool:
        # what callbacks look for after a step of the environment: there was none
        callback.update_locals({"actions": np.empty(0, dtype=np.float32), "infos": [], "dones": np.empty(0, dtype=bool)})
        return callback.on_step()

    # ------------------------------------------------------------------ saving

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_observations", "_actions", "_episode_ends"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []


@with_keywords_of(BC)
class BCRNN(BC):
    """
    Behaviour cloning with a recurrent network, in the way of robomimic's BC-RNN (Mandlekar et al., arXiv 2108.03298).

    It learns from sequences that begin anywhere in an episode, with an empty state, and end with it at the latest. When it
    plays, the state begins anew after as many steps, as in robomimic.

    Differences from robomimic:

    1. Mean squared error of the actions, not the likelihood of a Gaussian mixture.
    2. What would lie behind an episode's end is left out of the error, not filled up with its last transition.

    :param policy: "MlpPolicy"
    :param env: as :class:`BC`'s
    :param sequence_length: L
    :param carry_state: when it plays, keep the state beyond L steps, through the whole episode
    :param options: further keywords of :class:`BC`; ``policy_kwargs`` are those of
        :class:`~sb3_actpc.baselines.bc_policies.BCRNNPolicy`
    :raises ValueError: as :class:`BC`
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": BCRNNPolicy}

    def __init__(
        self,
        policy: str | type[CloningPolicy],
        env: GymEnv | str | None,
        *,
        sequence_length: int = 10,
        carry_state: bool = False,
        **options: Any,
    ) -> None:
        check_kinds(locals(), whole="sequence_length", flags="carry_state")
        check_range(locals(), "sequence_length", 1)
        self.sequence_length, self.carry_state = sequence_length, carry_state
        super().__init__(policy, env, **options)

    def _network_kwargs(self) -> dict[str, Any]:
        return {"restart_every": None if self.carry_state else self.sequence_length}

    def _loss(self, rows: th.Tensor) -> th.Tensor:
        """
        :param rows: (B,) where the sequences begin
        :return: mean squared error of the actions, over the steps that lie within an episode
        """
        steps = rows[:, None] + th.arange(self.sequence_length, device=self.device)
        within = (steps < self._episode_ends[rows][:, None]).float()
        steps = steps.clamp(max=len(self._actions) - 1)
        outputs, _ = self.policy(self._inputs(steps))
        errors = (outputs - self._actions[steps]).square().mean(dim=-1)
        return (errors * within).sum() / within.sum()
