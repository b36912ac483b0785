"""Checkpoints while an SB3 off-policy algorithm learns, and going on from them."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EventCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_actpc.actpc.self_imitation import map_observations
from sb3_actpc.checkpoints.bundle import Report, find_bundle, list_bundles, write_bundle
from sb3_actpc.checkpoints.interrupts import StopSignals, TrainingStopped
from sb3_actpc.checkpoints.settings import constructor_settings
from sb3_actpc.checkpoints.simulators import env_name
from sb3_actpc.checkpoints.state import capture_model, describe_model, restore_learning, restore_model, take_resumed
from sb3_actpc.utils.checks import check_finite

SelfAlgorithm = TypeVar("SelfAlgorithm", bound=OffPolicyAlgorithm)


def _warn(line: str) -> None:
    warnings.warn(line, stacklevel=3)


class CheckpointCallback(BaseCallback):
    """
    Saves everything that the training of any SB3 off-policy algorithm depends on, every ``save_freq`` steps and when the
    process is told to stop (SIGTERM, SIGINT); the latter raises :class:`~sb3_actpc.checkpoints.TrainingStopped`.

    A checkpoint is taken between two rollouts (``train_freq`` steps), or between two updates of a ``train()`` or a
    pre-training (see :func:`between_updates`) that a signal interrupts. The handlers that were there before come back when
    ``learn`` ends; after an error, call :meth:`close`.

    To go on, see :func:`restore` and :func:`continue_learning`.

    :param folder: of this run's checkpoints; made when it does not exist
    :param save_freq: environment steps between two checkpoints
    :param keep: how many stay
    :param handle_signals: save and stop on SIGTERM and SIGINT
    :param at_end: also save when ``learn`` ends
    :param report: given a line when something cannot be saved or restored; by default a warning
    :param verbose: 1 to report each checkpoint
    :raises ValueError: when a number is less than 1
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        save_freq: int = 10_000,
        keep: int = 3,
        handle_signals: bool = True,
        at_end: bool = True,
        report: Report | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        for name, value in (("save_freq", save_freq), ("keep", keep)):
            if value < 1:
                raise ValueError(f"{name}={value!r} must be at least 1")
        self.folder, self.save_freq, self.keep = Path(folder), save_freq, keep
        self.handle_signals, self.at_end = handle_signals, at_end
        self.report = _warn if report is None else report
        self.signals = StopSignals()
        self._others: list[BaseCallback] = []
        self._env_id = ""
        self._last_saved = 0
        self._samples: int | None = None  # drawn in the present train(), None outside of it
        self._planned, self._updates_before = 0, 0

    def close(self) -> None:
        """Put the old signal handlers back and leave the replay buffer alone again; ``learn`` does so when it ends."""
        self.signals.restore()
        self._samples = None
        if hasattr(self, "model"):
            unwatch(self._algorithm.replay_buffer)

    def save(self, gradient_steps_left: int = 0) -> Path:
        """
        Write a checkpoint now.

        :param gradient_steps_left: updates that the present ``train()`` had still to do
        :return: its folder
        :raises ValueError: when a weight is not finite
        :raises OSError: when it cannot be written; those there before stay
        """
        model = self._algorithm
        manifest = describe_model(model, self._env_id or env_name(self.training_env))
        manifest["settings"] = constructor_settings(model)
        with write_bundle(self.folder, model.num_timesteps, self.keep, manifest) as writer:
            capture_model(model, self._others, writer, gradient_steps_left)
        self._last_saved = model.num_timesteps
        path = list_bundles(self.folder)[-1]
        if self.verbose:
            self.report(f"step {model.num_timesteps:>8}  saved in {path}")
        return path

    @property
    def _algorithm(self) -> OffPolicyAlgorithm:
        assert isinstance(self.model, OffPolicyAlgorithm)
        return self.model

    # ------------------------------------------------------------------ hooks

    def _init_callback(self) -> None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise ValueError(f"{type(self.model).__name__} is not an off-policy algorithm: only those can be checkpointed")
        check_writable(self.folder)
        if self.handle_signals:
            self.signals.install()

    def _on_training_start(self) -> None:
        self._follow(self.locals.get("callback"))
        self._last_saved = self.num_timesteps
        if self.handle_signals:
            watch(self._algorithm.replay_buffer, self._on_sample)

    def _on_rollout_start(self) -> None:
        self._samples = None
        self._resume_or_stop()
        if self.num_timesteps - self._last_saved >= self.save_freq:
            self._save_or_report()

    def _on_step(self) -> bool:
        step = self.num_timesteps
        check_finite("agent", "actions", np.asarray(self.locals["actions"]), step)
        map_observations(lambda array: check_finite("environment", "observations", array, step), self.locals["new_obs"])
        check_finite("environment", "rewards", self.locals["rewards"], step)
        return True

    def _on_rollout_end(self) -> None:
        steps = self._algorithm.gradient_steps
        self._begin_updates(steps if steps >= 0 else self.locals["num_collected_steps"] * self.training_env.num_envs)

    def _on_training_end(self) -> None:
        self._resume()  # where no step was left
        self.close()
        if self.at_end and self._last_saved != self._algorithm.num_timesteps:
            self._save_or_report()

    def _follow(self, callback: Any) -> None:
        """Take note of the task and of the callbacks beside this one."""
        self._env_id = env_name(self.training_env)
        self._others = [one for one in callback_tree(callback) if one is not self]

    # ------------------------------------------------------------------ resuming

    def _resume(self) -> None:
        resumed = take_resumed(self._algorithm)
        if resumed is not None:
            self._finish_updates(restore_learning(self._algorithm, self._others, resumed, self.report))

    def _finish_updates(self, left: int) -> None:
        """What the interrupted ``train()`` had still to do, and what SB3 does between it and the start of the rollout."""
        if not left:
            return
        model = self._algorithm
        self._begin_updates(left)
        model.train(gradient_steps=left, batch_size=model.batch_size)
        self._samples = None
        model.policy.set_training_mode(False)
        if model.use_sde:
            model.actor.reset_noise(model.n_envs)  # type: ignore[operator]

    # ------------------------------------------------------------------ stopping

    def _resume_or_stop(self) -> None:
        self._resume()
        if self.signals.received:
            self._stop(0)

    def _begin_updates(self, planned: int) -> None:
        self._samples, self._planned, self._updates_before = 0, planned, self._algorithm._n_updates

    def _on_sample(self) -> None:
        """The replay buffer is about to be sampled: the update before has ended."""
        if self._samples is None:
            return
        if self.signals.received:
            # some algorithms count an update when it begins, others when all are done
            self._algorithm._n_updates = self._updates_before + self._samples
            self._stop(self._planned - self._samples)
        self._samples += 1

    def _stop(self, gradient_steps_left: int) -> None:
        assert self.signals.received is not None
        try:
            path = self.save(gradient_steps_left)
        finally:
            self.close()
        raise TrainingStopped(self.signals.received, self._algorithm.num_timesteps, str(path))

    def _save_or_report(self) -> None:
        """A full disk does not end the training: the checkpoints written before stay."""
        try:
            self.save()
        except OSError as error:
            self._last_saved = self._algorithm.num_timesteps  # not again at every step
            self.report(f"no checkpoint at step {self.num_timesteps}: {error.strerror or error}; those written before stay")


def between_updates(callback: BaseCallback) -> Callable[[], None]:
    """
    For algorithms that learn before their first rollout, in ``_setup_learn``, where SB3 calls no callback.

    :param callback: of this ``learn``, as SB3's ``_setup_learn`` returns it
    :return: to be called before each of those updates: goes on from a checkpoint taken there, and saves and stops on a signal
    """
    savers = [one for one in callback_tree(callback) if isinstance(one, CheckpointCallback)]
    for saver in savers:
        saver._follow(callback)

    def resume_or_stop() -> None:
        for saver in savers:
            saver._resume_or_stop()

    return resume_or_stop


# ---------------------------------------------------------------------- going on


def restore(model: OffPolicyAlgorithm, path: str | os.PathLike[str], report: Report = _warn) -> OffPolicyAlgorithm:
    """
    Put a checkpoint back into an agent made with the settings of the stopped run; :func:`continue_learning` goes on with it.

    :param model: the agent, with an environment made as the stopped run's
    :param path: a checkpoint, or the folder of several: the newest whole one is taken
    :param report: given a line for each damaged checkpoint, and when episodes must start again
    :return: the agent
    :raises FileNotFoundError: when there is no checkpoint
    :raises ValueError: when it is damaged, does not fit or was written in another version of the format
    """
    restore_model(model, find_bundle(path, report), report)
    return model


def continue_learning(model: SelfAlgorithm, callback: MaybeCallback = None, **options: Any) -> SelfAlgorithm:
    """
    Learn until the step that the stopped run was to reach.

    :param model: what :func:`restore` or ``load_checkpoint`` returned
    :param callback: those of the stopped run, made anew, a :class:`CheckpointCallback` among them
    :param options: further keywords of ``learn``, such as ``log_interval``
    :return: the agent
    :raises ValueError: without a :class:`CheckpointCallback`, which puts back what ``learn`` itself sets up
    """
    everything = callback_tree(CallbackList(callback) if isinstance(callback, list) else callback)
    savers = [one for one in everything if isinstance(one, CheckpointCallback)]
    if not savers:
        raise ValueError(f"callback={callback!r} has no CheckpointCallback: add one, it puts back what learn() itself sets up")
    left = model._total_timesteps - model.num_timesteps
    try:
        return model.learn(max(0, left), callback=callback, reset_num_timesteps=False, **options)
    finally:
        for saver in savers:
            saver.close()


def callback_tree(callback: Any) -> list[BaseCallback]:
    """A callback and all in it, lists left out, in the order in which they are called."""
    if callback is None or not isinstance(callback, BaseCallback):
        return []
    children = callback.callbacks if isinstance(callback, CallbackList) else []
    if isinstance(callback, EventCallback) and callback.callback is not None:
        children = [callback.callback]
    # SB3's EvalCallback has two
    after = getattr(callback, "callback_on_new_best", None)
    own = [] if isinstance(callback, CallbackList) else [callback]
    return [*own, *(one for child in [*children, after] for one in callback_tree(child))]


def check_writable(folder: Path) -> None:
    """
    :param folder: where checkpoints shall go; made when it does not exist
    :raises ValueError: when nothing can be written there
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ValueError(
            f"folder={str(folder)!r}: no checkpoint can be written there ({error.strerror or error}): choose another folder"
        ) from error


# ---------------------------------------------------------------------- the replay buffer, watched


def watch(buffer: ReplayBuffer | None, on_sample: Callable[[], None]) -> None:
    """
    Call ``on_sample`` whenever the buffer is about to be sampled, which every SB3 algorithm does once an update.

    The buffer gets a subclass of its class; when it is pickled, its own.

    :param buffer: the agent's
    :param on_sample: without arguments
    """
    if buffer is None or hasattr(buffer, "_unwatched_class"):
        return
    original: Any = type(buffer)

    class Watched(original):
        _unwatched_class = original

        def sample(self, *args: Any, **kwargs: Any) -> Any:
            on_sample()
            return super().sample(*args, **kwargs)

        def __reduce_ex__(self, protocol: Any) -> Any:
            return (_blank, (original,), *super().__reduce_ex__(protocol)[2:])

    Watched.__name__, Watched.__qualname__, Watched.__module__ = original.__name__, original.__qualname__, original.__module__
    buffer.__class__ = Watched


def _blank(kind: type) -> Any:
    """An object whose attributes are set by whoever copies or unpickles it."""
    return object.__new__(kind)


def unwatch(buffer: ReplayBuffer | None) -> None:
    """:param buffer: gets its own class back"""
    original = getattr(buffer, "_unwatched_class", None)
    if buffer is not None and original is not None:
        buffer.__class__ = original
