"""What the offline baselines share: they learn from demonstrations alone, by steps that do nothing in the environment."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs, Schedule
from typing_extensions import Self

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.mixin import LearnsFromDemonstrations
from sb3_actpc.utils.arguments import Positive, checked

SMALLEST_SPREAD = 1e-3  # an entry that hardly varies in the demonstrations is not blown up
LARGEST_INPUT = 10.0  # as in SB3's VecNormalize


class NormalizingPolicy(BasePolicy):
    """A policy that normalizes observations by the demonstrations' mean and standard deviation, and acts in [-1, 1], which is
    scaled to the environment's units."""

    mean: th.Tensor
    spread: th.Tensor

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Box, **options: Any) -> None:
        super().__init__(observation_space, action_space, normalize_images=False, squash_output=True, **options)
        self.n_inputs, self.n_outputs = (int(np.prod(space.shape or ())) for space in (observation_space, action_space))
        self.register_buffer("mean", th.zeros(self.n_inputs))
        self.register_buffer("spread", th.ones(self.n_inputs))

    def fit_normalization(self, observations: np.ndarray) -> None:
        """Entries of these observations, (N, obs_dim), shall get mean 0 and standard deviation 1."""
        rows = th.as_tensor(observations, device=self.device)
        self.mean.copy_(rows.mean(dim=0))
        self.spread.copy_(rows.std(dim=0, correction=0).clamp(min=SMALLEST_SPREAD))

    def normalized(self, observations: np.ndarray | PyTorchObs) -> th.Tensor:
        """Normalized observations (B, obs_dim), of any shape (B, *shape)."""
        rows = th.as_tensor(observations, dtype=th.float32, device=self.device).flatten(1)
        return ((rows - self.mean) / self.spread).clamp(-LARGEST_INPUT, LARGEST_INPUT)


class OfflineAlgorithm(LearnsFromDemonstrations):
    """An algorithm that learns from demonstrations alone.

    A step of ``learn`` is one gradient step on a batch of demonstrations: nothing is done in the environment, which gives the
    spaces and the demonstrations' task. Callbacks are called after each, so that evaluations at intervals work as for any
    other algorithm. Nothing is kept to resume from: a training is short enough to be run again.

    :param policy: "MlpPolicy"
    :param env: a task with Box observations and actions; for its spaces and for evaluations
    :param learning_rate: of the optimiser, or a schedule
    :param batch_size: B
    :param options: further keywords, of :class:`~sb3_actpc.demonstrations.mixin.LearnsFromDemonstrations` and of SB3's
        algorithms
    :raises ValueError: for a keyword with a value that is not allowed, without demonstrations, for demonstrations that do not
        fit the environment, for other spaces, and for an environment that normalises observations
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

    @abstractmethod
    def _new_policy(self) -> Any:
        """An untrained policy."""

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
            raise ValueError(f"demonstrations=None: {type(self).__name__} learns from nothing else, pass a file")
        if self.get_vec_normalize_env() is not None:
            raise ValueError(f"{type(self).__name__} normalises observations itself: leave VecNormalize out")
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
