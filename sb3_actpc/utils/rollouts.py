"""Rollouts that store their last transition and join no two episodes, also where callbacks stop or others interfere."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback, RolloutReturn, TrainFreq
from stable_baselines3.common.vec_env import VecEnv

from sb3_actpc.utils.env_hooks import WatchedVecEnv, copied


class _Deferred:
    """A callback whose wish to stop, or whose error, takes effect after the present transition is stored."""

    def __init__(self, callback: BaseCallback, frequency: SimpleNamespace, env: WatchedVecEnv) -> None:
        self.callback = callback
        self.frequency = frequency
        self.env = env
        self.stops = False
        self.error: BaseException | None = None

    def on_step(self) -> bool:
        try:
            self.stops = not self.callback.on_step()
        except BaseException as error:
            self.stops = True
            self.error = error
        self.env.put_back()
        if self.stops:
            self.frequency.frequency = 0
        return True

    def __getattr__(self, name: str) -> Any:
        return getattr(self.callback, name)


class StoresLastTransition(OffPolicyAlgorithm):
    """
    Every transition is stored, as it was when it arrived, and none joins two episodes.

    - SB3 asks the callback between the environment's step and its storage, so a callback that stops loses the transition.
      Here it is stored, and the episode is counted, before ``collect_rollouts`` returns; the same holds for an exception
      (Ctrl-C among them) that a callback raises. See SB3 issue 2056.
    - Someone else can step or reset the training environment, as ``evaluate_policy`` does: between two ``learn``, or in a
      callback. Then the running episodes are cut off, and the environment is reset before the next action. See SB3 issue 1684.
    - Observations are copied, since an environment may change the array that it has returned.
    """

    replay_buffer: Any  # one of this package, with ``cut_running_episodes``
    _watched: WatchedVecEnv | None = None

    def _watch(self) -> WatchedVecEnv:
        """The training environment, watched; the same object until the algorithm is given another one."""
        assert self.env is not None
        if self._watched is None or self._watched.venv is not self.env:
            self._watched = WatchedVecEnv(self.env)
        return self._watched

    @property
    def is_disturbed(self) -> bool:
        """Whether someone else has stepped or reset the training environment since the last transition."""
        return self._watched is not None and self._watched.venv is self.env and self._watched.is_disturbed

    def _cut_running_episodes(self) -> None:
        """The environments are reset in mid-episode: what the replay buffer holds of these episodes has ended."""
        self.replay_buffer.cut_running_episodes()

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **options: Any,
    ) -> tuple[int, BaseCallback]:
        self._is_reset = reset_num_timesteps or self._last_obs is None  # by SB3, before it prepares the callbacks
        if self._is_reset:
            self._cut_running_episodes()
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **options)
        self._last_obs = copied(self._last_obs)
        self._last_original_obs = copied(self._last_original_obs)
        return result

    def _init_callback(self, *args: Any, **options: Any) -> BaseCallback:
        if self._is_reset:
            self._watch().mark()
        return super()._init_callback(*args, **options)

    def _restart_if_disturbed(self) -> None:
        """Before an action is chosen: it must be for the observation in which the environment is."""
        if not self.is_disturbed:
            return
        self._cut_running_episodes()
        self._last_obs = self._watch().reset()
        if self._vec_normalize_env is not None:
            self._last_original_obs = copied(self._vec_normalize_env.get_original_obs())
        self._last_episode_starts = np.ones(self.n_envs, dtype=bool)
        if self.action_noise is not None:
            self.action_noise.reset()

    def _sample_action(self, *args: Any, **options: Any) -> tuple[np.ndarray, np.ndarray]:
        self._restart_if_disturbed()
        return super()._sample_action(*args, **options)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, train_freq: TrainFreq, *args: Any, **options: Any
    ) -> RolloutReturn:
        """As SB3's. After an exception the state of the environment is unknown: the next ``learn`` resets it."""
        # SB3's, but the frequency can fall to 0: then SB3 finishes the present step and collects no more
        frequency: Any = SimpleNamespace(frequency=train_freq.frequency, unit=train_freq.unit)
        deferred = _Deferred(callback, frequency, self._watch())
        try:
            rollout = super().collect_rollouts(self._watch(), cast(BaseCallback, deferred), frequency, *args, **options)
            if deferred.error is not None:
                raise deferred.error
        except BaseException:
            self._last_obs = None
            raise
        return RolloutReturn(rollout.episode_timesteps, rollout.n_episodes, not deferred.stops)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_watched", "_is_reset"]
