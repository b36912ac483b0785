"""What the offline baselines share: they learn from demonstrations alone, by steps that do nothing in the environment."""

from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.mixin import LearnsFromDemonstrations
from sb3_actpc.utils.arguments import Positive, checked

SelfOffline = TypeVar("SelfOffline", bound="OfflineAlgorithm")


class OfflineAlgorithm(LearnsFromDemonstrations):
    """An algorithm that learns from demonstrations alone.

    A step of ``learn`` is one gradient step on a batch of demonstrations: nothing is done in the environment, which gives the
    spaces and the demonstrations' task. Callbacks are called after each, so that evaluations at intervals work as for any
    other algorithm. Nothing is kept to resume from: a training is short enough to be run again.

    :param policy: "MlpPolicy"
    :param env: a task with Box observations and actions; for its spaces and for evaluations
    :param demonstrations: as of :class:`~sb3_actpc.demonstrations.mixin.LearnsFromDemonstrations`, with ``n_demonstrations``
        and ``n_demonstration_transitions``
    :param learning_rate: of the optimiser, or a schedule; the other keywords are SB3's
    :param batch_size: B
    :raises ValueError: for a keyword with a value that is not allowed, without demonstrations, for demonstrations that do not
        fit the environment, for other spaces, and for an environment that normalises observations
    """

    is_offline: ClassVar[bool] = True  # for those who run any algorithm: its steps do nothing in the environment

    @checked
    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None,
        *,
        demonstrations: Demonstrations | str | Path | None = None,
        n_demonstrations: int | None = None,
        n_demonstration_transitions: int | None = None,
        learning_rate: float | Schedule = 1e-3,
        batch_size: Positive = 256,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            support_multi_env=True,
            supported_action_spaces=(spaces.Box,),
            demonstrations=demonstrations,
            n_demonstrations=n_demonstrations,
            n_demonstration_transitions=n_demonstration_transitions,
        )
        self.batch_size = batch_size
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._check_actions()
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        kwargs = {**self._network_kwargs(), **self.policy_kwargs}
        policy = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **kwargs)
        self.policy = policy.to(self.device)
        if self.env is not None:
            self._load_demonstrations()

    def _network_kwargs(self) -> dict[str, Any]:
        """Keywords of the policy that follow from the algorithm's."""
        return {}

    def train(self) -> None:
        """One gradient step; every hundredth logs its losses."""
        losses = self._gradient_step()
        self._n_updates += 1
        if self._n_updates % 100 == 0:
            for name, loss in losses.items():
                self.logger.record(f"train/{name}", float(loss))
            self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    @abstractmethod
    def _gradient_step(self) -> Mapping[str, float | th.Tensor]:
        """Learn from a batch: the losses, by name."""

    def _validate(self) -> None:
        """Choose what acts from now on; nothing to choose here."""

    @abstractmethod
    def _take(self, demonstrations: Demonstrations) -> None:
        """Learn from these demonstrations, which fit the environment."""

    def _load_demonstrations(self) -> None:
        if self.demonstrations is None:
            raise ValueError(f"demonstrations=None: {type(self).__name__} learns from nothing else, pass a file")
        if self.get_vec_normalize_env() is not None:
            raise ValueError(f"{type(self).__name__} normalises observations itself: leave VecNormalize out")
        self._take(self._fitted_demonstrations())

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As SB3's; an agent that was loaded without an environment gets its demonstrations now."""
        super().set_env(env, force_reset)
        self._load_demonstrations()

    def learn(
        self: SelfOffline,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1000,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfOffline:
        """As SB3's: ``total_timesteps`` are gradient steps, callbacks are called after each, and ``log_interval`` of them
        lie between two lines of the log (None: no log)."""
        if self.env is None:
            raise ValueError(f"{type(self).__name__} was loaded without an environment: set_env() first")
        name = tb_log_name or type(self).__name__
        total, callback = self._setup_learn(total_timesteps, callback, reset_num_timesteps, name, progress_bar)
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total:
            self._update_current_progress_remaining(self.num_timesteps, total)
            self.train()
            self.num_timesteps += 1
            if log_interval is not None and self._n_updates % log_interval == 0:
                self.logger.dump(self.num_timesteps)
            # what callbacks look for after a step of the environment: there was none
            nothing = np.empty(0, dtype=bool)
            callback.update_locals({"actions": np.empty(0, dtype=np.float32), "infos": [], "dones": nothing})
            if not callback.on_step():
                break
        self._validate()
        callback.on_training_end()
        return self
