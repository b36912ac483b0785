"""TD3 and DDPG with demonstrations; actor and critic have rates, optimisers and target rates of their own, as in the paper."""

from collections import defaultdict
from typing import Any, Literal

import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.utils import polyak_update
from typing_extensions import Self

from sb3_actpc.baselines.demonstrated import DemonstratedAlgorithm
from sb3_actpc.baselines.normalization import NormalizedObservations
from sb3_actpc.utils.arguments import Count, Weight, checked
from sb3_actpc.utils.nested import map_observations

OPTIMIZERS: dict[str, type[th.optim.Optimizer]] = {"adam": th.optim.Adam, "adamw": th.optim.AdamW}
SMALLEST_VALUE = 1e-8  # mean absolute action-value that divides
BC_LEARNING_RATE = 1e-3  # falls linearly to 0
BC_BATCH_SIZE = 256
NETWORK_KEYWORDS = {"learning_rate", "optimizer", "tau"}


class TD3Demo(DemonstratedAlgorithm, TD3):
    """Stable-Baselines3's TD3 (Fujimoto et al., arXiv 1802.09477) with a share of demonstrations in every batch.

    Without demonstrations and without ``actor_kwargs`` and ``critic_kwargs`` it is SB3's TD3, number by number.

    :param args: policy and env, as SB3's
    :param actor_kwargs: of the actor alone: ``learning_rate`` (a number; it follows the schedule of the algorithm's),
        ``optimizer`` ("adam" or "adamw") and ``tau``
    :param critic_kwargs: the same for the critic
    :param policy_gradient_weight: of minus the mean action-value, where a cloning loss is added; otherwise 1
    :param cloning_weight: of the mean over the batch's demonstrations of the squared distance between action and
        demonstrated action (scaled to [-1, 1], summed over its dimensions unless ``normalize_values``); 0 for none
    :param q_filter: clone only the demonstrated actions that the critic values above the actor's own
    :param normalize_values: the loss of TD3+BC (Fujimoto and Gu, arXiv 2106.06860) with ``policy_gradient_weight=2.5,
        cloning_weight=1.0``: ``policy_gradient_weight`` is divided by the batch's mean absolute action-value, and the cloning
        loss is a mean over the action's dimensions
    :param bc_steps: steps of behavior cloning on the demonstrations, before the first ``learn`` begins
    :param observation_normalization: "demonstrations" normalizes observations by their mean and standard deviation (as TD3+BC
        does by its data), "none" leaves them as they are
    :param options: keywords of :class:`~sb3_actpc.baselines.demonstrated.DemonstratedAlgorithm` and of SB3's TD3
    :raises ValueError: for a keyword with a value that is not allowed, for demonstrations that do not fit the environment
    """

    @checked
    def __init__(
        self,
        *args: Any,
        actor_kwargs: dict[str, Any] | None = None,
        critic_kwargs: dict[str, Any] | None = None,
        policy_gradient_weight: Weight = 1.0,
        cloning_weight: Weight = 0.0,
        q_filter: bool = False,
        normalize_values: bool = False,
        bc_steps: Count = 0,
        observation_normalization: Literal["none", "demonstrations"] = "none",
        **options: Any,
    ) -> None:
        self.actor_kwargs = actor_kwargs or {}
        self.critic_kwargs = critic_kwargs or {}
        self.policy_gradient_weight = policy_gradient_weight
        self.cloning_weight = cloning_weight
        self.q_filter = q_filter
        self.normalize_values = normalize_values
        self.bc_steps = bc_steps
        self.observation_normalization = observation_normalization
        if observation_normalization == "demonstrations":
            policy_kwargs = options.get("policy_kwargs") or {}
            if "features_extractor_class" in policy_kwargs:
                raise ValueError(
                    "observation_normalization='demonstrations' is a features extractor itself: use 'none', or leave "
                    "features_extractor_class out of policy_kwargs"
                )
            extractor = {"features_extractor_class": NormalizedObservations, "normalize_images": False}
            options["policy_kwargs"] = {**policy_kwargs, **extractor}
        super().__init__(*args, **options)

    def _setup_model(self) -> None:
        super()._setup_model()
        for network, given in self._networks():
            kind = OPTIMIZERS.get(given.get("optimizer", "adam"))
            if kind is None or not given.keys() <= NETWORK_KEYWORDS:
                raise ValueError(
                    f"{given} of a network: choose from {sorted(NETWORK_KEYWORDS)}, optimizers {list(OPTIMIZERS)}"
                )
            if given.keys() - {"tau"}:
                rate = given.get("learning_rate", self.lr_schedule(1.0))
                network.optimizer = kind(network.parameters(), lr=rate)  # type: ignore[call-arg]

    @property
    def imitates_first(self) -> bool:
        """Whether the first ``learn`` begins with behavior cloning."""
        return bool(self.bc_steps) and self.demonstrations is not None

    def _networks(self) -> list[tuple[BaseModel, dict[str, Any]]]:
        return [(self.actor, self.actor_kwargs), (self.critic, self.critic_kwargs)]

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """TD3's updates: so many of the critic; the actor and the targets follow every ``policy_delay``."""
        self._losses: dict[str, list[float]] = defaultdict(list)
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        for network, given in self._networks():
            if "learning_rate" in given:  # it falls as the schedule does
                progress = self.lr_schedule(self._current_progress_remaining) / self.lr_schedule(1.0)
                network.optimizer.param_groups[0]["lr"] = given["learning_rate"] * progress
        for _ in range(gradient_steps):
            self._n_updates += 1
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            self._update_critic(batch)
            if self._n_updates % self.policy_delay == 0:
                self._step("actor", self.actor, self._actor_loss(batch, self.actor(batch.observations)))
                self._update_targets()
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in self._losses.items():
            self.logger.record(f"train/{name}", np.mean(values))

    def _step(self, name: str, network: BaseModel, loss: th.Tensor) -> None:
        self._losses[f"{name}_loss"].append(loss.item())
        network.optimizer.zero_grad()
        loss.backward()
        network.optimizer.step()

    def _update_critic(self, batch: Any) -> None:
        """Clipped double Q-learning with target policy smoothing."""
        discounts = self.gamma if batch.discounts is None else batch.discounts
        with th.no_grad():
            noise = batch.actions.clone().normal_(0, self.target_policy_noise)
            noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
            next_actions = (self.actor_target(batch.next_observations) + noise).clamp(-1, 1)
            targets = batch.rewards + (1 - batch.dones) * discounts * self._next_values(batch, next_actions)
        values = self.critic(batch.observations, batch.actions)
        self._step("critic", self.critic, self._critic_loss(th.stack(values), targets))

    def _next_values(self, batch: Any, next_actions: th.Tensor) -> th.Tensor:
        """What the targets bootstrap from, given the target actor's smoothed actions (B, A): (B, 1)."""
        return th.cat(self.critic_target(batch.next_observations, next_actions), dim=1).amin(dim=1, keepdim=True)

    def _critic_loss(self, values: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """Mean squared error of values (n_critics, B, 1) and targets (B, 1), summed over the critics."""
        return sum((th.nn.functional.mse_loss(one, targets) for one in values), start=values.new_zeros(()))

    def _actor_loss(self, batch: Any, actions: th.Tensor) -> th.Tensor:
        """Minus the mean action-value of the actor's actions, (B, A), and the cloning loss on the demonstrated rows."""
        values = self._actor_values(batch.observations, actions)
        n_demonstrated = self.replay_buffer.n_demonstrated(len(actions))
        if not (n_demonstrated and self.cloning_weight):
            return -values.mean()
        last = slice(len(actions) - n_demonstrated, None)
        own, demonstrated = actions[last], batch.actions[last]
        is_cloned = th.ones_like(batch.rewards[last])
        if self.q_filter:
            rows = map_observations(lambda part: part[last], batch.observations)
            with th.no_grad():
                is_cloned = (self.critic.q1_forward(rows, demonstrated) > self.critic.q1_forward(rows, own)).float()
        self._losses["cloned_share"].append(is_cloned.mean().item())
        distances = (own - demonstrated).square().sum(dim=1, keepdim=True)
        value_weight = self.policy_gradient_weight
        if self.normalize_values:
            distances = distances / own.shape[1]
            value_weight = value_weight / values.detach().abs().mean().clamp(min=SMALLEST_VALUE).item()
        return self.cloning_weight * (distances * is_cloned).mean() - value_weight * values.mean()

    def _actor_values(self, observations: Any, actions: th.Tensor) -> th.Tensor:
        """The action-values that the actor climbs, (B, 1): the first critic's."""
        return self.critic.q1_forward(observations, actions)

    def learn(self, total_timesteps: int, *args: Any, **options: Any) -> Self:
        """As SB3's; the first call fits the normalization and begins with ``bc_steps`` steps of behavior cloning."""
        is_new = not self.num_timesteps and not self._n_updates
        normalizes = self.observation_normalization == "demonstrations"
        if is_new and (normalizes or self.imitates_first) and self.has_normalized_observations:
            needs = "observation_normalization='demonstrations'" if normalizes else f"bc_steps={self.bc_steps}"
            raise ValueError(f"{needs} needs observations that stay as they are: use VecNormalize(norm_obs=False)")
        if is_new and normalizes:
            self._fit_normalization()
        if is_new and self.imitates_first:
            self._clone_actor()
        return super().learn(total_timesteps, *args, **options)

    def _fit_normalization(self) -> None:
        parts = [part for part in self.policy.modules() if isinstance(part, NormalizedObservations)]
        if self.demonstrations is None or not parts:
            raise ValueError(
                "observation_normalization='demonstrations' needs demonstrations=, and to be given to the constructor: "
                "use 'none' without them"
            )
        observations = self._fitted_demonstrations().observations
        for part in parts:
            part.fit(observations)

    def _clone_actor(self) -> None:
        """Start the actor as behavior cloning does: least squares on the demonstrated actions, in [-1, 1]."""
        demonstrated: Any = self.replay_buffer.demonstrated
        optimizer = th.optim.Adam(self.actor.parameters(), lr=BC_LEARNING_RATE)
        self.actor.set_training_mode(True)
        for step in range(self.bc_steps):
            optimizer.param_groups[0]["lr"] = BC_LEARNING_RATE * (1 - step / self.bc_steps)
            batch = demonstrated.sample(BC_BATCH_SIZE, self._vec_normalize_env)
            loss = th.nn.functional.mse_loss(self.actor(batch.observations), batch.actions)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        self.actor_target.load_state_dict(self.actor.state_dict())

    def _update_targets(self) -> None:
        self._follow("critic")
        self._follow("actor")
        # running means of batch normalization are copied, as in SB3
        polyak_update(self.critic_batch_norm_stats, self.critic_batch_norm_stats_target, 1.0)
        polyak_update(self.actor_batch_norm_stats, self.actor_batch_norm_stats_target, 1.0)

    def _follow(self, name: str) -> None:
        """Move a network's target towards it."""
        tau = getattr(self, f"{name}_kwargs").get("tau", self.tau)
        polyak_update(getattr(self, name).parameters(), getattr(self, f"{name}_target").parameters(), tau)


class DDPGDemo(TD3Demo):
    """DDPG with demonstrations (the paper's DDPG-Demo), after Nair et al., arXiv 1709.10089.

    From there: demonstrations in every batch, a cloning loss on them, the Q-filter (only demonstrated actions that the critic
    values above the actor's are cloned) and both weights (λ1 = 0.001 of the policy gradient, λ2 = 1 / 128 of the cloning loss
    summed over 128 demonstrations, that is 1 of its mean). DDPG itself is SB3's: TD3 with one critic, no delay, no noise
    in the targets. With ``cloning_weight=0`` and ``policy_gradient_weight=1`` it is SB3's DDPG.

    Differences from Nair et al.:

    1. Episodes start as the task starts them; theirs also start from demonstrated states.
    2. No hindsight relabelling here; :class:`~sb3_actpc.baselines.HER` adds it.
    3. Returns are one-step unless ``n_steps`` says otherwise.
    4. No L2 penalty on weights, unless ``actor_kwargs`` asks for AdamW.

    :param args: policy and env, as SB3's
    :param options: keywords of :class:`TD3Demo`; ``demonstration_fraction`` is 1 / 9 unless given (Nair et al.: 128 of 1152)
    """

    def __init__(self, *args: Any, policy_kwargs: dict[str, Any] | None = None, **options: Any) -> None:
        sb3s_ddpg = {"policy_delay": 1, "target_policy_noise": 0.1, "target_noise_clip": 0.0}
        nairs = {"policy_gradient_weight": 0.001, "cloning_weight": 1.0, "q_filter": True, "demonstration_fraction": 1 / 9}
        policy_kwargs = {"n_critics": 1, **(policy_kwargs or {})}
        super().__init__(*args, policy_kwargs=policy_kwargs, **{**sb3s_ddpg, **nairs, **options})
