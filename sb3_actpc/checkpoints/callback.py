"""Checkpoints while an SB3 algorithm learns, and going on from them."""

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback

from sb3_actpc.checkpoints.bundle import Report, find_bundle, list_bundles, write_bundle
from sb3_actpc.checkpoints.interrupts import StopSignals, TrainingStopped
from sb3_actpc.checkpoints.state import Restored, capture_model, describe_model, restore
from sb3_actpc.utils.checks import check_finite
from sb3_actpc.utils.settings import constructor_settings, read_settings


class CheckpointCallback(BaseCallback):
    """
    Saves everything that the training of an SB3 algorithm depends on, every ``save_freq`` steps and when the process is told
    to stop (SIGTERM, SIGINT); the latter raises :class:`~sb3_actpc.checkpoints.TrainingStopped`.

    A checkpoint is taken between two rollouts (``train_freq`` steps). The handlers that were there before come back when
    ``learn`` ends; after an error, call :meth:`close`. To go on, see :func:`restore` and :func:`continue_learning`.

    :param folder: of this run's checkpoints; made when it does not exist
    :param save_freq: environment steps between two checkpoints
    :param keep: how many stay
    :param at_end: also save when ``learn`` ends
    :param report: given a line when something cannot be saved or restored; by default a warning
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        save_freq: int = 10_000,
        keep: int = 3,
        at_end: bool = True,
        report: Report = warnings.warn,
    ) -> None:
        if save_freq < 1 or keep < 1:
            raise ValueError(f"save_freq={save_freq!r} and keep={keep!r} must be at least 1")
        super().__init__()
        self.folder = Path(folder)
        self.save_freq = save_freq
        self.keep = keep
        self.at_end = at_end
        self.report = report
        self.restored: Restored | None = None  # what ``learn`` goes on from; :func:`continue_learning` sets it
        self.signals = StopSignals()
        self._others: list[BaseCallback] = []
        self._last_saved = 0

    def close(self) -> None:
        """Put the old signal handlers back; ``learn`` does so when it ends."""
        self.signals.restore()

    def save(self) -> Path:
        """Write a checkpoint now, and return its folder; ValueError when a weight is not finite, OSError when it cannot be
        written: those there before stay."""
        model = self.model
        manifest = {**describe_model(model), "settings": constructor_settings(model)}
        with write_bundle(self.folder, model.num_timesteps, self.keep, manifest) as write:
            capture_model(model, self._others, write)
        self._last_saved = model.num_timesteps
        return list_bundles(self.folder)[-1]

    def _init_callback(self) -> None:
        reason = why_no_checkpoints(type(self.model))
        if reason:
            raise ValueError(f"{type(self.model).__name__} {reason}: leave the callback out")
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.restored is None and not self._last_saved and list_bundles(self.folder):
            self.report(
                f"{self.folder} holds checkpoints of another run, which this one's replace: give each run its own folder"
            )
        self.signals.install()

    def _on_training_start(self) -> None:
        self._others = [one for one in callback_tree(self.locals.get("callback")) if one is not self]
        self._last_saved = self.num_timesteps

    def _on_rollout_start(self) -> None:
        self._resume()
        if self.signals.received is not None:
            try:
                path = self.save()
            finally:
                self.close()
            raise TrainingStopped(self.signals.received, self.model.num_timesteps, str(path))
        if self.num_timesteps - self._last_saved >= self.save_freq:
            self._save_or_report()

    def _on_step(self) -> bool:
        step = self.num_timesteps
        check_finite("agent", "actions", np.asarray(self.locals["actions"]), step)
        seen = self.locals["new_obs"]
        for observations in seen.values() if isinstance(seen, dict) else [seen]:
            check_finite("environment", "observations", observations, step)
        check_finite("environment", "rewards", self.locals["rewards"], step)
        return True

    def _on_training_end(self) -> None:
        self._resume()  # where no step was left
        self.close()
        if self.at_end and self._last_saved != self.model.num_timesteps:
            self._save_or_report()

    def _resume(self) -> None:
        if self.restored is not None:
            self.restored.put_back(self._others)
            self.restored = None

    def _save_or_report(self) -> None:
        """A full disk does not end the training: the checkpoints written before stay."""
        try:
            self.save()
        except OSError as error:
            self._last_saved = self.model.num_timesteps  # not again at every step
            self.report(f"no checkpoint at step {self.num_timesteps}: {error}; those written before stay")


def why_no_checkpoints(algorithm: type[BaseAlgorithm]) -> str:
    """Why the training of a class of algorithms cannot be stopped and gone on with; empty where it can. ``is_resumable =
    False`` in the class says that SB3's state is not all of its own."""
    learns_by_rollouts = issubclass(algorithm, (OffPolicyAlgorithm, OnPolicyAlgorithm))
    return "" if learns_by_rollouts and getattr(algorithm, "is_resumable", True) else "keeps no checkpoints"


def load_checkpoint(
    algorithm: type[BaseAlgorithm],
    path: str | os.PathLike[str],
    env: GymEnv | str,
    report: Report = warnings.warn,
    **overrides: Any,
) -> Restored:
    """Make an agent with the settings of a checkpoint and put everything back into it; no code is run from the file.

    :param algorithm: the agent's class
    :param path: as in :func:`restore`, and ``report`` too
    :param env: an environment made as the stopped run's
    :param overrides: constructor keywords: those that could not be stored by name, and what may differ (``device``, ...)
    :return: as :func:`restore` does, and raises the same
    """
    bundle = find_bundle(path, report)
    stored = bundle.manifest["agent"]["algorithm"]
    if stored != algorithm.__name__:
        raise ValueError(f"{bundle.path} is a checkpoint of {stored}, not {algorithm.__name__}: load it with that class")
    keywords = read_settings(bundle.manifest["settings"], overrides)
    return restore(algorithm(env=env, **keywords), bundle, report)


def continue_learning(restored: Restored, callback: MaybeCallback = None, **options: Any) -> BaseAlgorithm:
    """Learn until the step that the stopped run was to reach.

    :param restored: what :func:`restore` or ``load_checkpoint`` returned
    :param callback: new ones like those of the stopped run, a :class:`CheckpointCallback` among them
    :param options: further keywords of ``learn``, such as ``log_interval``
    :return: the agent
    :raises ValueError: without a :class:`CheckpointCallback`, which puts back what ``learn`` itself sets up
    """
    everything = callback_tree(CallbackList(callback) if isinstance(callback, list) else callback)
    savers = [one for one in everything if isinstance(one, CheckpointCallback)]
    if not savers:
        raise ValueError(f"callback={callback!r} has no CheckpointCallback: add one, it puts back what learn() itself sets up")
    savers[0].restored = restored
    model = restored.model
    left = model._total_timesteps - model.num_timesteps
    try:
        return model.learn(max(0, left), callback=callback, reset_num_timesteps=False, **options)
    finally:
        for saver in savers:
            saver.close()


def callback_tree(callback: Any) -> list[BaseCallback]:
    """A callback and all in it, lists left out, in the order in which they are called."""
    if isinstance(callback, CallbackList):
        return [one for child in callback.callbacks for one in callback_tree(child)]
    if not isinstance(callback, BaseCallback):
        return []
    children = [getattr(callback, name, None) for name in ("callback", "callback_on_new_best")]  # SB3's EvalCallback has both
    return [callback, *(one for child in children for one in callback_tree(child))]
