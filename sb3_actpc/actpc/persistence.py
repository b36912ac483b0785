"""Saving and loading an agent: SB3's files, checkpoints and files of weights."""

from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from stable_baselines3.common.type_aliases import GymEnv
from torch import nn

from sb3_actpc.actpc.buffers import SignalReplay
from sb3_actpc.actpc.demonstration_replay import DemonstrationReplay
from sb3_actpc.actpc.diagnostics import Diagnostics
from sb3_actpc.actpc.policies import ActPCPolicy
from sb3_actpc.actpc.reward_signals import InternalSignals, RewardSignal
from sb3_actpc.actpc.validation import check_expert_rows, check_loaded_buffer, named_file_errors
from sb3_actpc.checkpoints import Restored, load_checkpoint
from sb3_actpc.guidance import ActorGuidance
from sb3_actpc.utils.rollouts import StoresLastTransition
from sb3_actpc.utils.weights import load_weights, save_weights

SelfPersistent = TypeVar("SelfPersistent", bound="Persistent")
NEED_DEMONSTRATIONS = ("demonstration_fraction", "n_demonstrations", "n_demonstration_transitions")
_ALIASES = ("actor", "critic", "generator", "prior", "actor_target", "critic_target")
_DERIVED = ("expert", "diagnostics", "epistemic", "instrumental", "actor_guidance")
_OF_A_RUN = ("_used_demonstrations", "_described", "_is_stepping")


class Persistent(StoresLastTransition):
    """What ActPC adds to SB3's saving and loading. The attributes are the agent's, which creates them."""

    policy: ActPCPolicy
    expert: DemonstrationReplay | None
    signals: InternalSignals
    epistemic: RewardSignal
    instrumental: RewardSignal
    diagnostics: Diagnostics
    actor_guidance: ActorGuidance
    _rollout_state: tuple[np.ndarray, ...] | None
    _rollout_starts: np.ndarray

    @classmethod
    def load(cls: type[SelfPersistent], path: str | PathLike[str], *args: Any, **kwargs: Any) -> SelfPersistent:  # type: ignore[override]
        """
        As in SB3, which unpickles: load files that you trust.

        :raises ValueError: for a file of a version whose classes are not here, or of another algorithm
        """
        with named_file_errors(path):
            return super().load(path, *args, **kwargs)  # type: ignore[arg-type]

    def set_parameters(self, *args: Any, **kwargs: Any) -> None:
        """As in SB3. Returns of the deployed policy say nothing of another one, and a circuit's own learning
        rate is a setting, not a parameter."""
        scales = [group["lr_scale"] for group in self._parameter_groups()]
        super().set_parameters(*args, **kwargs)
        for group, scale in zip(self._parameter_groups(), scales, strict=True):
            group["lr_scale"] = scale
        self.actor_guidance.forget_returns()

    def _parameter_groups(self) -> list[dict[str, Any]]:
        return [group for _, circuit in self.policy.named_circuits() for group in circuit.optimizer.param_groups]

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint (:mod:`sb3_actpc.checkpoints`) keeps beside SB3's state: plain values and arrays."""
        expert = self.expert
        return {
            "rollout_state": self._rollout_state,
            "rollout_starts": self._rollout_starts,
            "signals": self.signals.checkpoint_state(),
            "expert_signals": None if expert is None else [expert.epistemic, expert.instrumental, expert.has_signals],
            "diagnostics": dict(self.diagnostics.values),
            "guidance": self.actor_guidance.state_dict(),
        }

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """
        :param state: what :meth:`checkpoint_state` returned
        :raises ValueError: when it was taken with other demonstrations
        """
        stored = state["expert_signals"]
        check_expert_rows(0 if stored is None else len(stored[0]), 0 if self.expert is None else len(self.expert))
        if self.expert is not None:
            self.expert.epistemic, self.expert.instrumental, self.expert.has_signals = stored
        self._rollout_state = state["rollout_state"]
        self._rollout_starts = state["rollout_starts"]
        self.signals.restore_checkpoint_state(state["signals"])
        self.diagnostics.values = dict(state["diagnostics"])
        self.actor_guidance.load_state_dict(state["guidance"])

    @classmethod
    def load_checkpoint(cls, path: str | PathLike[str], env: GymEnv | str, **keywords: Any) -> Restored:
        """
        Go on from a checkpoint: see :func:`sb3_actpc.checkpoints.load_checkpoint` and ``continue_learning`` there.

        :param path: a checkpoint, or the folder of several: the newest whole one is taken
        :param env: an environment made as the stopped run's
        :param keywords: constructor keywords that replace the stored ones, such as ``demonstrations``
        """
        return load_checkpoint(cls, path, env, **keywords)

    @classmethod
    def pretrained(cls, env_id: str, env: GymEnv | None = None, **keywords: Any) -> "Persistent":
        """
        A trained agent that comes with the package, to act: see :func:`sb3_actpc.pretrained.load_pretrained`.

        :param env_id: the environment that it was trained on, such as ``SparseReacher-v5``
        :param env: an environment with the same spaces; by default one is made from the id
        :param keywords: constructor keywords that replace the stored ones
        :raises ValueError: when no agent comes with the package for this environment
        """
        from sb3_actpc.pretrained import load_pretrained  # it imports the agent

        return load_pretrained(env_id, env, **keywords)

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        """
        As in SB3, which unpickles: load files that you trust.

        :raises ValueError: for a buffer of another algorithm, number of environments or shapes; the agent keeps its own
        """
        given = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded = self.replay_buffer
        self.replay_buffer = given
        is_own = isinstance(loaded, SignalReplay)
        check_loaded_buffer(path, loaded, is_own, self.n_envs, self.observation_space, self.action_space)
        assert isinstance(loaded, SignalReplay)
        loaded.history = self.policy.memory_history
        self.replay_buffer = loaded
        self._last_obs = None  # its running episodes are not the agent's: the next ``learn`` resets the environments

    def save_weights(self, path: str | PathLike[str]) -> Path:
        """
        Write weights and settings into a file that cannot run code: see :func:`sb3_actpc.utils.weights.save_weights`.

        :param path: file to write; ``.safetensors`` is added where it is missing
        :return: the file
        """
        return save_weights(self, path)

    @classmethod
    def from_weights(
        cls: type[SelfPersistent], path: str | PathLike[str], env: GymEnv | str, **keywords: Any
    ) -> SelfPersistent:
        """
        An agent from a file of :meth:`save_weights`: see :func:`sb3_actpc.utils.weights.load_weights`.

        :param path: the file
        :param env: the environment, or its id
        :param keywords: constructor keywords that replace the stored ones; ``demonstrations`` are not in the file
        """
        without: tuple[str, ...] = ()
        if keywords.get("demonstrations") is None:
            without = (*NEED_DEMONSTRATIONS, "observation_normalization")
        return load_weights(cls, path, env, without=without, **keywords)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *_ALIASES, *_DERIVED, *_OF_A_RUN]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names = [name if name != "actor" else "actor.circuit" for name, _ in self.policy.named_circuits()]
        learned = [name for name in ("epistemic", "instrumental") if isinstance(getattr(self, name), nn.Module)]
        return ["policy", *(f"policy.{name}.optimizer" for name in names), *learned], []
