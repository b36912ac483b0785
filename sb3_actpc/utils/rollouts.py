"""Rollouts that store their last transition, whoever stops them."""

from typing import Any, cast

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import RolloutReturn, TrainFreq
from stable_baselines3.common.vec_env import VecEnv


class _Frequency:
    """SB3's ``TrainFreq``, whose frequency can fall to 0: then SB3 finishes the present step and collects no more."""

    def __init__(self, train_freq: TrainFreq) -> None:
        self.frequency = train_freq.frequency
        self.unit = train_freq.unit


class _Deferred:
    """A callback whose wish to stop, or whose error, takes effect after the present transition is stored."""

    def __init__(self, callback: BaseCallback, frequency: _Frequency) -> None:
        self.callback = callback
        self.frequency = frequency
        self.stops = False
        self.error: BaseException | None = None

    def on_step(self) -> bool:
        try:
            self.stops = not self.callback.on_step()
        except BaseException as error:
            self.stops = True
            self.error = error
        if self.stops:
            self.frequency.frequency = 0
        return True

    def __getattr__(self, name: str) -> Any:
        return getattr(self.callback, name)


class StoresLastTransition(OffPolicyAlgorithm):
    """
    SB3 asks the callback between the environment's step and its storage, so a callback that stops loses the transition.

    Here that transition is stored, and the episode is counted, before ``collect_rollouts`` returns; the same holds for an
    exception (Ctrl-C among them) that a callback raises. See SB3 issue 2056.
    """

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        """As SB3's."""
        frequency = _Frequency(train_freq)
        deferred = _Deferred(callback, frequency)
        rollout = super().collect_rollouts(
            env,
            cast(BaseCallback, deferred),
            cast(TrainFreq, frequency),
            replay_buffer,
            action_noise,
            learning_starts,
            log_interval,
        )
        if deferred.error is not None:
            raise deferred.error
        return RolloutReturn(rollout.episode_timesteps, rollout.n_episodes, not deferred.stops)
