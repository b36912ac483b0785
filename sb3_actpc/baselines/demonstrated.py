"""What baselines share: demonstrations that fit the task, and, off policy, a share of them in every batch."""

import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv, RolloutReturn
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.baselines.demonstration_buffers import WithDemonstrations, demonstration_buffer_class
from sb3_actpc.demonstrations.mixin import LearnsFromDemonstrations
from sb3_actpc.utils.arguments import Share, checked
from sb3_actpc.utils.rollouts import StoresLastTransition


class DemonstratedAlgorithm(LearnsFromDemonstrations, StoresLastTransition):
    """An off-policy algorithm whose replay buffer is one of :mod:`sb3_actpc.baselines.demonstration_buffers`.

    An agent that is loaded without an environment, to be played, gets a buffer of one transition and does not look for its
    demonstrations; :meth:`set_env` makes the whole buffer.

    :param args: policy and env, as SB3's
    :param demonstration_fraction: share of each batch that comes from the demonstrations; without them it has no effect
    :param options: keywords of :class:`LearnsFromDemonstrations` and of the algorithm
    :raises ValueError: as there, and for a share out of range
    """

    @checked
    def __init__(self, *args: Any, demonstration_fraction: Share = 0.5, **options: Any) -> None:
        self.demonstration_fraction = demonstration_fraction
        super().__init__(*args, **options)

    def _setup_model(self) -> None:
        self._check_actions()
        asked = self.replay_buffer_class
        buffer = self._make_replay_buffer() if self.replay_buffer is None else self.replay_buffer
        self.replay_buffer = buffer
        super()._setup_model()
        # SB3 replaces None by its own default, and SBX makes a buffer of its own
        self.replay_buffer_class = asked
        self.replay_buffer = buffer

    def _replay_class(self) -> type[WithDemonstrations]:
        return demonstration_buffer_class(self.replay_buffer_class, self.observation_space, self.n_steps)

    def _make_replay_buffer(self) -> ReplayBuffer:
        kind, kwargs = self._replay_class(), dict(self.replay_buffer_kwargs)
        size = self.buffer_size
        demonstrations = None
        if self.env is None:
            kind = demonstration_buffer_class(None, self.observation_space)  # which needs none
            kwargs, size = {}, self.n_envs
        else:
            if self.demonstrations is not None:
                demonstrations = self._fitted_demonstrations()
            if self.n_steps > 1:
                kwargs = {"n_steps": self.n_steps, "gamma": self.gamma, **kwargs}
            if issubclass(kind, HerReplayBuffer):
                kwargs["env"] = self.env
        return kind(
            size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage and self.env is not None,
            demonstrations=demonstrations,
            demonstration_fraction=self.demonstration_fraction,
            **kwargs,
        )

    def collect_rollouts(self, *args: Any, **options: Any) -> RolloutReturn:
        """As SB3's. After an exception or Ctrl-C the state of the environment is unknown: the next ``learn`` resets it."""
        try:
            return super().collect_rollouts(*args, **options)
        except BaseException:
            self._cut_running_episodes()
            self._last_obs = None
            raise

    def _setup_learn(
        self, total_timesteps: int, callback: Any = None, reset_num_timesteps: bool = True, *args: Any, **options: Any
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps:  # SB3 resets the environment
            self._cut_running_episodes()
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **options)

    def _cut_running_episodes(self) -> None:
        buffer = self.replay_buffer
        if isinstance(buffer, HerReplayBuffer):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # SB3 warns that it does what is asked for
                buffer.truncate_last_trajectory()
        elif isinstance(buffer, NStepReplayBuffer):
            last = buffer.pos - 1
            buffer.timeouts[last] = np.logical_or(buffer.timeouts[last], np.logical_not(buffer.dones[last]))

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As SB3's; an agent that was loaded without an environment gets its replay buffer and its demonstrations now."""
        was_without = self.env is None
        super().set_env(env, force_reset)
        if was_without:
            self.replay_buffer = self._make_replay_buffer()

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint (:mod:`sb3_actpc.checkpoints`) keeps beside SB3's state: how many demonstrations there were."""
        return {"n_demonstrated": self._n_demonstrated()}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """ValueError when it was taken with other demonstrations."""
        if state["n_demonstrated"] != self._n_demonstrated():
            raise ValueError(
                f"the checkpoint's agent has {state['n_demonstrated']} demonstrated transitions, this one "
                f"{self._n_demonstrated()}: pass the same demonstrations="
            )

    def _n_demonstrated(self) -> int:
        demonstrated = getattr(self.replay_buffer, "demonstrated", None)
        return 0 if demonstrated is None else demonstrated.buffer_size
