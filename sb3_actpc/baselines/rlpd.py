"""RLPD on SBX's SAC: reinforcement learning with prior data. Needs the extra ``jax``."""

from typing import Any, ClassVar

import jax  # type: ignore[import-not-found]
import jax.numpy as jnp  # type: ignore[import-not-found]
import numpy as np
import torch as th
from sbx import SAC
from sbx.sac.policies import SACPolicy
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import get_device

from sb3_actpc.baselines.demonstrated import (
    DemonstratedAlgorithm,
    DemonstrationHerReplayBuffer,
    DemonstrationReplayBuffer,
)
from sb3_actpc.utils.arguments import Positive, checked
from sb3_actpc.utils.normalization import ObservationNormalizer

N_TARGET_CRITICS = 2  # drawn to bootstrap (REDQ, arXiv 2101.05982)


class RLPDPolicy(SACPolicy):
    """SBX's SAC policy with layer-normalized critics, for observations normalized by the demonstrations.

    :param n_critics: number of critics, at least two
    """

    def __init__(self, *args: Any, n_critics: int = 10, **options: Any) -> None:
        super().__init__(*args, **{"layer_norm": True, **options, "n_critics": n_critics})
        self.mean = np.zeros(1, dtype=np.float32)
        self.scale = np.ones(1, dtype=np.float32)
        self.clip = np.inf

    def fit_normalization(self, observations: np.ndarray) -> None:
        """Give these observations, (N, obs_dim), mean 0 and standard deviation 1, but for constant entries."""
        normalizer = ObservationNormalizer(observations.shape[1])
        normalizer.fit(th.as_tensor(observations))
        self.mean, self.scale, self.clip = normalizer.mean.numpy(), normalizer.scale.numpy(), normalizer.clip.item()

    def normalized(self, observations: np.ndarray) -> np.ndarray:
        """Normalized observations, (B, obs_dim)."""
        rows = (observations - self.mean) * self.scale
        return np.clip(rows, -self.clip, self.clip).astype(np.float32)

    def prepare_obs(self, observation: Any) -> tuple[np.ndarray, bool]:
        """As SBX's, normalized; they are flattened, (n, obs_dim)."""
        rows, is_batch = super().prepare_obs(observation)
        return self.normalized(rows.reshape(len(rows), -1)), is_batch


class RLPD(DemonstratedAlgorithm, SAC):
    """RLPD (Ball et al., arXiv 2302.02948): SAC with half of every batch from the demonstrations.

    Critics are layer-normalized, two drawn target critics bootstrap, and the actor climbs the mean of all critics.
    ``gradient_steps`` updates of the critics follow each environment step, and one of the actor.

    Differences from RLPD's code (github.com/ikostrikov/rlpd):

    1. Observations are normalized by the demonstrations' mean and standard deviation, or else by VecNormalize.
    2. The target has no entropy term for any task; there the task decides.
    3. Returns can be n-step (``n_steps``).
    4. The entropy weight begins with 0.1 and holds an entropy of minus the number of action dimensions, unless ``ent_coef``
       and ``target_entropy`` say otherwise (there 1, and minus half the number).

    :param args: policy, "MlpPolicy" or "MultiInputPolicy", and env; ``policy_kwargs`` takes ``net_arch`` and ``n_critics``
    :param gradient_steps: critic updates per environment step, and per actor update unless ``policy_delay`` is given
    :param hindsight: relabel goals, those of the demonstrations too (hindsight replay, not of RLPD's paper); for goal tasks
    :param options: keywords of :class:`~sb3_actpc.baselines.demonstrated.DemonstratedAlgorithm` and of SBX's SAC, whose
        ``ent_coef`` is "auto_0.1" unless given; ``target_entropy`` can also be "half", minus half the number of action
        dimensions
    :raises ValueError: for a keyword with a value that is not allowed, for demonstrations that do not fit the environment
    """

    policy: RLPDPolicy
    target_entropy: Any
    is_resumable: ClassVar[bool] = False  # checkpoints hold torch networks, these are JAX's
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": RLPDPolicy, "MultiInputPolicy": RLPDPolicy}

    @checked
    def __init__(self, *args: Any, gradient_steps: Positive = 10, hindsight: bool = False, **options: Any) -> None:
        entropy = options.get("target_entropy", "auto")
        if isinstance(entropy, str) and entropy not in ("auto", "half"):
            raise ValueError(f"target_entropy={entropy!r} must be 'auto', 'half' or a number")
        self.hindsight = hindsight
        options = {"policy_delay": gradient_steps, "ent_coef": "auto_0.1", **options}
        super().__init__(*args, gradient_steps=gradient_steps, **options)

    def _replay_class(self) -> type[DemonstrationReplayBuffer]:
        return DemonstrationHerReplayBuffer if self.hindsight else super()._replay_class()

    def _setup_model(self) -> None:
        self.device = get_device("cpu")  # of the replay buffer: SBX takes its batches as NumPy arrays
        if self.target_entropy == "half":
            self.target_entropy = -0.5 * float(np.prod(self.action_space.shape or ()))
        is_new = getattr(self, "policy", None) is None
        super()._setup_model()
        has_data = self.env is not None and self.demonstrations is not None
        if is_new and has_data and not self.has_normalized_observations:
            self.policy.fit_normalization(self._fitted_demonstrations().observations)

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """The updates of one step, once the buffer can be sampled from."""
        if self.replay_buffer.can_sample(gradient_steps * batch_size):
            super().train(gradient_steps, batch_size)

    def _train(self, tau: float, target_entropy: Any, gradient_steps: int, data: Any, *states: Any) -> Any:
        """SBX's updates, on normalized observations. SBX cuts the rows into batches, and the demonstrated rows come last: each
        batch takes every ``gradient_steps``-th row, so that all hold the same share of demonstrations."""
        rows = np.arange(len(data.rewards)).reshape(-1, gradient_steps).T.ravel()
        data = data._replace(
            observations=self.policy.normalized(data.observations.reshape(len(rows), -1)),
            next_observations=self.policy.normalized(data.next_observations.reshape(len(rows), -1)),
        )
        batches = type(data)(*(column[rows] for column in data))
        return super()._train(tau, target_entropy, gradient_steps, batches, *states)

    @staticmethod
    @jax.jit
    def update_critic(*arguments: Any) -> Any:
        """One update of all critics: their new state, (loss, entropy weight), and key."""
        actor_state, qf_state, ent_coef_state, observations, actions, next_observations, *rest = arguments
        rewards, dones, discounts, key = rest  # the first three (B,)
        key, action_key, draw_key = jax.random.split(key, 3)
        next_actions = actor_state.apply_fn(actor_state.params, next_observations).sample(seed=action_key)
        # (n_critics, B, 1)
        next_values = qf_state.apply_fn(qf_state.target_params, next_observations, next_actions)
        drawn = jax.random.choice(draw_key, len(next_values), (N_TARGET_CRITICS,), replace=False)
        bootstrap = next_values[drawn].min(axis=0)[:, 0]
        targets = rewards + (1 - dones) * discounts * bootstrap

        def critic_loss(params: Any) -> jax.Array:
            values = qf_state.apply_fn(params, observations, actions)[..., 0]
            return 0.5 * jnp.square(values - targets).mean(axis=1).sum()

        loss, gradients = jax.value_and_grad(critic_loss)(qf_state.params)
        entropy_weight = ent_coef_state.apply_fn({"params": ent_coef_state.params})
        return qf_state.apply_gradients(grads=gradients), (loss, entropy_weight), key

    @staticmethod
    @jax.jit
    def update_actor(actor_state: Any, qf_state: Any, ent_coef_state: Any, observations: jax.Array, key: jax.Array) -> Any:
        """One update of the actor: its new state, that of the critics, loss, key and mean entropy."""
        key, action_key = jax.random.split(key)
        entropy_weight = ent_coef_state.apply_fn({"params": ent_coef_state.params})

        def actor_loss(params: Any) -> tuple[jax.Array, jax.Array]:
            distribution = actor_state.apply_fn(params, observations)
            actions = distribution.sample(seed=action_key)
            entropy = -distribution.log_prob(actions).mean()
            values = qf_state.apply_fn(qf_state.params, observations, actions)
            return -values.mean() - entropy_weight * entropy, entropy

        (loss, entropy), gradients = jax.value_and_grad(actor_loss, has_aux=True)(actor_state.params)
        return actor_state.apply_gradients(grads=gradients), qf_state, loss, key, entropy
