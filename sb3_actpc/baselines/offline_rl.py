"""BCQ and CQL by d3rlpy, evaluated as every other algorithm is."""

import io
from dataclasses import fields
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_actpc.baselines.bc import NormalizingPolicy, OfflineAlgorithm
from sb3_actpc.demonstrations import Demonstrations, scaled_actions
from sb3_actpc.utils.arguments import checked
from sb3_actpc.utils.extras import import_extra


class D3rlpyPolicy(NormalizingPolicy):
    """A policy whose networks are d3rlpy's."""

    learner: Any  # one of d3rlpy's algorithms

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        actions = self.learner.predict(self.normalized(observation).cpu().numpy())
        return th.as_tensor(actions, dtype=th.float32, device=self.device).clamp(-1, 1)


class D3rlpyAlgorithm(OfflineAlgorithm):
    """What d3rlpy's methods share: observations are normalized by the demonstrations' mean and standard deviation, actions are
    scaled to [-1, 1], and all is computed on the CPU.

    :param args: policy and env of :class:`~sb3_actpc.baselines.bc.OfflineAlgorithm`
    :param batch_size: B
    :param method_kwargs: the method's own settings, by d3rlpy's names, and ``net_arch``, the hidden sizes of all networks
    :param options: further keywords as there; the learning rates are among ``method_kwargs``
    :raises ValueError: as there
    :raises ImportError: when d3rlpy is not installed
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": D3rlpyPolicy}
    policy: D3rlpyPolicy
    method: ClassVar[str]

    @checked
    def __init__(self, *args: Any, batch_size: int = 100, method_kwargs: dict[str, Any] | None = None, **options: Any) -> None:
        if "learning_rate" in options:
            raise ValueError("learning_rate has no effect: set actor_learning_rate, ... in method_kwargs")
        self.method_kwargs = method_kwargs or {}
        self.trained = b""  # the networks and their optimizers, when the agent was last saved
        super().__init__(*args, batch_size=batch_size, **options)

    @classmethod
    def check_installed(cls) -> Any:
        """d3rlpy; ImportError, which names the commands that install it, when it is not there."""
        return import_extra("d3rlpy", "d3rlpy")

    def _new_policy(self) -> D3rlpyPolicy:
        d3rlpy = self.check_installed()
        policy = super()._new_policy()
        settings = {"batch_size": self.batch_size, **self.method_kwargs}
        hidden = d3rlpy.models.VectorEncoderFactory(hidden_units=settings.pop("net_arch", [256, 256]))
        config = getattr(d3rlpy.algos, f"{self.method}Config")
        encoders = {field.name: hidden for field in fields(config) if field.name.endswith("_encoder_factory")}
        try:
            policy.learner = config(**encoders, **settings).create(device=False)
        except TypeError as error:
            raise ValueError(f"method_kwargs={self.method_kwargs}: {error}") from error
        policy.learner.create_impl((policy.n_inputs,), policy.n_outputs)
        if self.trained:
            policy.learner.impl.load_model(io.BytesIO(self.trained))
        return policy

    def _take(self, demonstrations: Demonstrations) -> None:
        if not self.trained:  # a loaded agent keeps the normalization that its networks learned with
            self.policy.normalization.fit(demonstrations.observations)
        # one that goes on does not draw the same batches again
        self._random = np.random.default_rng(None if self.seed is None else self.seed + self._n_updates)
        self._transitions = {
            "observations": demonstrations.observations,
            "next_observations": demonstrations.next_observations,
            "actions": scaled_actions(demonstrations, self.action_space),  # type: ignore[arg-type]
            "rewards": demonstrations.rewards[:, None],
            "terminals": demonstrations.terminations[:, None].astype(np.float32),
        }

    def _gradient_step(self) -> dict[str, float]:
        from d3rlpy.dataset import TransitionMiniBatch

        rows = self._random.integers(len(self._transitions["actions"]), size=self.batch_size)
        batch: dict[str, Any] = {name: part[rows] for name, part in self._transitions.items()}
        for name in ("observations", "next_observations"):
            batch[name] = self.policy.normalized(batch[name]).cpu().numpy()
        unread = {"next_actions": np.zeros_like(batch["actions"]), "transitions": []}  # by either method
        return self.policy.learner.update(TransitionMiniBatch(**batch, **unread, intervals=np.ones_like(batch["rewards"])))

    def save(self, path: Any, exclude: Any = None, include: Any = None) -> None:
        """As SB3's."""
        networks = io.BytesIO()
        self.policy.learner.impl.save_model(networks)
        self.trained = networks.getvalue()
        super().save(path, exclude, include)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_transitions", "_random"]


class BCQ(D3rlpyAlgorithm):
    """Batch-constrained Q-learning (Fujimoto et al., arXiv 1812.02900) by d3rlpy, as it is there."""

    method = "BCQ"


class CQL(D3rlpyAlgorithm):
    """Conservative Q-learning (Kumar et al., arXiv 2006.04779) by d3rlpy, as it is there."""

    method = "CQL"
