"""ActPC: active predictive coding as a Stable-Baselines3 algorithm (Ororbia & Mali, arXiv 2209.09174, Algorithm 1)."""

import warnings
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.actpc.base import ActPCBase
from sb3_actpc.actpc.batches import Batch, last_observations
from sb3_actpc.actpc.buffers import SignalReplay, relabels
from sb3_actpc.actpc.policies import POLICIES, ActPCPolicy, check_policy
from sb3_actpc.actpc.reward_signals import InternalSignals, check_reward_weights
from sb3_actpc.actpc.validation import check_step
from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.recording import ENDLESS
from sb3_actpc.guidance import ActorGuidance
from sb3_actpc.guidance.behavior_cloning import add_noise
from sb3_actpc.ngc import HebbianChanges, settle_coupled
from sb3_actpc.utils.arguments import (
    MAX_SEED,
    Between,
    DemonstrationLimit,
    Share,
    Size,
    Weight,
    check_env,
    check_learning_rate,
    check_noise,
    check_train_freq,
    checked,
)
from sb3_actpc.utils.checks import Settings, check_device, check_finite

# the mean absolute action-value that divides the critic term is at least this: before any reward was seen, the critic's
# noise must not be scaled up to full strength
SMALLEST_VALUE_SCALE = 1.0
TD3_BC_WEIGHT = 2.5  # α of TD3+BC
TARGET_NOISE_CLIP = 2.5  # standard deviations, as TD3's 0.5 for 0.2


class ActPC(ActPCBase):
    """
    Active predictive coding: four NGC circuits that learn by settling and Hebbian changes, never by backprop.

    The actor acts; the critic values its actions; the generator's surprise is an epistemic reward; the prior, learned from
    demonstrations and then frozen, gives an instrumental one. Paper: https://arxiv.org/abs/2209.09174.

    Defaults are one setting for all demonstrations (README has its results); the paper's own values are in
    ``hyperparams/actpc_paper.yml``. These keywords have one value with demonstrations and one without:

    ====================================== ============== =======
    keyword                                demonstrations without
    ====================================== ============== =======
    ``learning_starts``                    0              100
    ``n_steps``                            3              1
    ``self_imitation_size`` (buffer's)     100,000        0
    ``demonstration_fraction``             0.5            0
    ``observation_normalization``          demonstrations none
    ``guidance``                           default        none
    ====================================== ============== =======

    :param policy: "MlpPolicy", "MultiInputPolicy", "CnnPolicy" (fixed random convolutions) or a class
    :param env: the environment, or its id
    :param learning_rate: of all circuits, or a schedule; circuits can have their own (``policy_kwargs``)
    :param buffer_size: transitions in the replay buffer
    :param learning_starts: environment steps with random actions before anything is learned
    :param batch_size: of all circuits; circuits can have their own (``policy_kwargs``)
    :param tau: share of the way that target circuits move towards the circuits
    :param gamma: discount
    :param train_freq: environment steps (or episodes) between updates
    :param gradient_steps: updates each time; -1 for as many as steps were collected
    :param action_noise: exploration noise on actions in [-1, 1]: a Gaussian's standard deviation, one of SB3's noises, or None
    :param replay_buffer_class: None, or one of SB3's classes or its name (its ActPC counterpart is used)
    :param replay_buffer_kwargs: keywords of :class:`~sb3_actpc.actpc.buffers.SignalReplay` and of SB3's class
    :param optimize_memory_usage: as in SB3; not with an epistemic weight, as the generator learns where every step led
    :param n_steps: length of n-step returns; 1 by default with hindsight, ``optimize_memory_usage`` or
        ``target_policy_noise=None``
    :param settling: "scheduled" (one ordered sweep of the errors, Z-IL) or "iterative" (settle, then change; with
        ``circuit_kwargs=dict(dynamics="state")`` the paper's K steps of eq. 1)
    :param demonstrations: a path, a Minari id, or a :class:`~sb3_actpc.demonstrations.dataset.Demonstrations`; others can be
        set later (``agent.demonstrations = ...``)
    :param n_demonstrations: use only the first so many episodes of them, or, as ``(300, "transitions")``, so many transitions
        (the paper's "300 samples")
    :param refresh_weight: λ, weight of the actor's refresh from the demonstrations and its own good episodes
    :param demonstration_fraction: share of every batch that comes from the demonstrations
    :param reward_weights: weights of the ``epistemic`` and the ``instrumental`` signal (the paper's α_ep and α_in; here 0) and
        of the ``task``'s reward (α_ext, the paper's is 0 with demonstrations; here 1)
    :param signal_kwargs: keywords of :class:`~sb3_actpc.actpc.reward_signals.InternalSignals`
    :param critic_weight: weight of the critic term in the actor's update. None is TD3+BC's rule (arXiv 2106.06860), 2.5
        divided by the batch's mean absolute action-value (at least 1); 0 leaves imitation alone
    :param policy_delay: updates of the critic for each of the actor; the paper's is 1
    :param target_policy_noise: standard deviation of the noise on the target actor's next action, which bootstraps (the
        paper's appendix); None for the action taken in its place (the main text's equation)
    :param target_update_interval: the targets move after every update (1), or every so many environment steps
    :param observation_normalization: "none" (the paper), "demonstrations" (their mean and standard deviation) or "bounds"
        (those of the observation space become -1 and 1)
    :param guidance: "none" (as in the paper), "default" or an :class:`~sb3_actpc.guidance.base.ActorGuidance`
    :param guidance_kwargs: keywords of :class:`~sb3_actpc.guidance.guidance.GuidanceConfig`
    :param policy_kwargs: keywords of :class:`~sb3_actpc.actpc.policies.ActPCPolicy`
    :param tensorboard_log: as in SB3, and so are ``verbose``, ``device`` and ``seed``
    :raises ValueError: for values, spaces or demonstrations that do not fit
    :raises FileNotFoundError: where no demonstrations file is
    :raises ImportError: for a Minari id without the extra ``minari``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = POLICIES
    policy: ActPCPolicy

    @checked
    def __init__(
        self,
        policy: Annotated[str | type[ActPCPolicy], check_policy],
        env: Annotated[GymEnv | str, check_env],
        learning_rate: Annotated[float | Schedule, check_learning_rate] = 3e-4,
        buffer_size: Size = 1_000_000,
        learning_starts: Annotated[float | None, Between(0)] = None,
        batch_size: Size = 128,
        tau: Share = 0.005,
        gamma: Share = 0.99,
        train_freq: Annotated[int | tuple[int, str], check_train_freq] = 1,
        gradient_steps: Annotated[int, Between(-1)] = 4,
        action_noise: Annotated[ActionNoise | float | None, check_noise] = 0.1,
        replay_buffer_class: type[ReplayBuffer] | str | None = None,
        replay_buffer_kwargs: Settings | None = None,
        optimize_memory_usage: bool = False,
        n_steps: Annotated[int | None, Between(1)] = None,
        *,
        settling: Literal["iterative", "scheduled"] = "scheduled",
        demonstrations: Demonstrations | str | Path | None = None,
        n_demonstrations: DemonstrationLimit = None,
        refresh_weight: Weight = 1.0,
        demonstration_fraction: Annotated[float | None, Between(0, 1)] = None,
        reward_weights: Annotated[Settings | None, check_reward_weights] = None,
        signal_kwargs: Settings | None = None,
        critic_weight: Annotated[float | None, Between(0)] = None,
        policy_delay: Size = 4,
        target_policy_noise: Annotated[float | None, Between(0)] = 0.2,
        target_update_interval: Annotated[int, Between(1)] = 1,
        observation_normalization: Literal["none", "demonstrations", "bounds"] | None = None,
        guidance: ActorGuidance | str | None = None,
        guidance_kwargs: Settings | None = None,
        policy_kwargs: Settings | None = None,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        device: Annotated[th.device | str, check_device] = "auto",
        seed: Annotated[int | None, Between(0, MAX_SEED)] = None,
        _init_setup_model: bool = True,
    ) -> None:
        # Keywords left at None have one value with demonstrations and one without
        has_demonstrations = demonstrations is not None
        is_one_step = relabels(replay_buffer_class) or optimize_memory_usage or target_policy_noise is None
        if learning_starts is None:
            learning_starts = 0 if has_demonstrations else 100
        if n_steps is None:
            n_steps = 3 if has_demonstrations and not is_one_step else 1
        if demonstration_fraction is None:
            demonstration_fraction = 0.5 if has_demonstrations else 0.0
        if observation_normalization is None:
            observation_normalization = "demonstrations" if has_demonstrations else "none"
        if guidance is None:
            guidance = "default" if has_demonstrations else "none"
        # Without demonstrations the first good episodes would hold the actor back, as nothing filters their imitation
        replay_buffer_kwargs = dict(replay_buffer_kwargs or {})
        if not has_demonstrations:
            replay_buffer_kwargs.setdefault("self_imitation_size", 0)
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=dict(policy_kwargs or {}),
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            supported_action_spaces=(spaces.Box,),
            support_multi_env=True,
            demonstrations=demonstrations,
            n_demonstrations=n_demonstrations,
        )
        self.settling = settling
        self.refresh_weight = refresh_weight
        self.demonstration_fraction = demonstration_fraction
        self.reward_weights = dict(reward_weights or {})
        self.signal_kwargs = signal_kwargs
        self.critic_weight = critic_weight
        self.policy_delay = policy_delay
        self.target_policy_noise = target_policy_noise
        self.target_update_interval = target_update_interval
        self.observation_normalization = observation_normalization
        self.guidance = guidance
        self.guidance_kwargs = guidance_kwargs
        self.signals = InternalSignals()
        self.made_with = {}
        self.was_made_without_demonstrations = not has_demonstrations
        if _init_setup_model:
            self._setup_model()
            self._check_settings()
            self._check_needs_met()
            self._setup_demonstrations()

    # ------------------------------------------------------------------ collecting (Algorithm 1, lines 8 to 16)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """As in SB3: actions for the environments, and the same in [-1, 1]."""
        self._restart_if_disturbed()
        is_random = self.num_timesteps < learning_starts
        # a_t = f_proj(o_t): the actor, or a circuit that guidance evaluates. The working memory follows random actions too
        if self.policy.memory_history or not is_random:
            assert self._last_obs is not None
            actions, self._rollout_state = self.actor.roll_out(
                self.actor.obs_to_tensor(self._last_obs)[0],
                self._rollout_state,
                self._rollout_starts,
                self.actor_guidance.acting_circuits(self._context()),
            )
        if is_random:
            actions = self.policy.scale_action(np.array([self.action_space.sample() for _ in range(n_envs)]))
        check_finite("actor", "actions", actions, self.num_timesteps)
        # Exploration noise, where guidance lets the episode have some
        if action_noise is not None:
            explores = np.array([self.actor_guidance.explores(env) for env in range(n_envs)])
            explores = explores.reshape(-1, *[1] * (actions.ndim - 1))
            actions = np.clip(actions + explores * action_noise(), -1.0, 1.0).astype(np.float32)
        return self.policy.unscale_action(actions), actions

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """As in SB3; integer observations behind VecNormalize are stored as they were."""
        assert isinstance(replay_buffer, SignalReplay)
        check_step(new_obs, reward, infos, self.num_timesteps)
        # Observations and rewards as the environment gave them, before VecNormalize and before its reset
        normalize = self._vec_normalize_env
        observations = self._last_obs
        next_observations = new_obs
        rewards = reward
        if normalize is not None:
            observations = self._last_original_obs
            next_observations = normalize.get_original_obs()
            rewards = normalize.get_original_reward()
        last = last_observations(next_observations, dones, infos, normalize)
        # A signal that has a weight only now scores what is stored
        self._score_stored()
        # Store (o_t, a_t, r_t, o_t+1), then its signals
        replay_buffer.add(observations, last, buffer_action, rewards, dones, infos)
        if self.used_weights.has_signals:
            replay_buffer.store_signals(*self.score_newest())
        self._last_obs = new_obs
        self._last_original_obs = next_observations
        starts = self._rollout_starts
        self._rollout_starts = np.array(dones, dtype=bool)
        # Guidance counts steps of policies, not random ones
        if self.num_timesteps >= self.learning_starts + self.n_envs:
            self.actor_guidance.on_step(self._context(starts), rewards, dones, self._n_updates)
        if self.expert is not None and np.any(dones):
            self.expert.check_scale(replay_buffer.rewards[: replay_buffer.size()])
        waits = self.actor_guidance.has_gate or isinstance(replay_buffer, HerReplayBuffer)
        if waits and ENDLESS in replay_buffer.running_lengths:
            warnings.warn(
                f"an episode has gone on for {ENDLESS} steps: the deployment gate and hindsight wait for its end, so set one "
                "with gymnasium.wrappers.TimeLimit",
                stacklevel=2,
            )

    # ------------------------------------------------------------------ learning (Algorithm 1, lines 17 to 26)

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """
        The updates of Algorithm 1, ``gradient_steps`` times; with hindsight from the first ended episode on.

        :param gradient_steps: how many updates of the critic
        :param batch_size: B, of the circuits without one of their own
        """
        if not self.replay_buffer.can_sample:
            return
        self.policy.set_training_mode(True)
        # Update learning rates according to the schedule
        learning_rate = self.lr_schedule(self._current_progress_remaining)
        self.logger.record("train/learning_rate", learning_rate)
        self.policy.set_learning_rate(learning_rate)

        # Line 17: sample minibatches, the newest transition in each
        sizes = self.policy.batch_sizes(batch_size)
        for batch in self.sample_batches(gradient_steps, batch_size):
            self._n_updates += 1
            self.diagnostics.begin_update(self._n_updates, self.num_timesteps, self.policy_delay)
            # Lines 19 and 26, delayed: Θ_a += η (ΔΘ_a under the critic's output error 1/A + λ ΔΘ_a of the refresh)
            if self._n_updates % self.policy_delay == 0:
                self.update_actor(batch.first(sizes["actor"]))
            # Lines 21 and 22: t_j = r_j + γ c_j, Θ_c += η ΔΘ_c with the output clamped to t_j
            self.update_critic(batch.first(sizes["critic"]))
            # Line 24: Θ_g += η ΔΘ_g with the output clamped to o_j+1
            self.update_generator(batch.first(sizes["generator"]))
            # Target circuits: Θ' += τ (Θ - Θ')
            if self.target_update_interval == 1:
                self.update_targets()
        self._log_training()

    def update_actor(self, batch: Batch) -> None:
        """Critic term (line 19) and imitation term (line 26), added up for one step of the optimizer."""
        changes: list[HebbianChanges] = []
        # Imitation: settle on demonstrated actions and those of good episodes, ΔΘ_a = e φ(z)ᵀ
        imitation_weight = self.refresh_weight * self.actor_guidance.imitation_weight(self._n_updates)
        if imitation_weight and self.imitated_episodes():
            features, actions, memory = self.sample_imitated(len(batch.features))
            chain = self.actor.circuit.chain(add_noise(features, self.actor_guidance.input_noise), memory)
            filtered_weight = self.actor_guidance.filtered_weight(self._n_updates)
            if self.has_critic_term and filtered_weight < 1.0:
                actions = self.q_filter(features, actions, chain.output, filtered_weight)
            state = self.actor.circuit.settle_chain(chain, actions)
            imitation = self.actor.circuit.hebbian_update(state).scale_(imitation_weight)
            self.diagnostics.settled("actor", state)
            self.diagnostics.change_norms("imitation", imitation)
            changes.append(imitation)
        # Critic term: actor and critic settle as one under the critic's output error +1/A, ΔΘ_a = e φ(z)ᵀ
        share = self.actor_guidance.critic_weight(self._n_updates)
        if self.has_critic_term and share:
            coupled = settle_coupled(self.actor.circuit, self.critic, batch.features, batch.memory, self.policy.nudge)
            improvement = self.actor.circuit.hebbian_update(coupled.actor)
            self.diagnostics.coupled(coupled, improvement, batch.features, batch.memory)
            # By TD3+BC's rule the term does not depend on the scale of the action-values
            weight: float | th.Tensor | None = self.critic_weight
            if weight is None:
                weight = TD3_BC_WEIGHT / coupled.action_values.abs().mean().clamp_min(SMALLEST_VALUE_SCALE)
            improvement.scale_(share * weight)
            self.diagnostics.change_norms("critic_term", improvement)
            if not changes:
                self.diagnostics.settled("actor", coupled.actor)
            changes.append(improvement)
        # Θ_a += η ΣΔΘ_a
        if changes:
            total = changes[0]
            for other in changes[1:]:
                total.add_(other)
            self.actor.circuit.apply_changes(total)
            self.actor_guidance.after_update(self._context())

    def q_filter(self, features: th.Tensor, actions: th.Tensor, own: th.Tensor, weight: float = 0.0) -> th.Tensor:
        """Imitated actions, (B, A). Where all critics value the actor's ``own`` more, these, which have no error (without a
        leak), or the point a ``weight`` of the way to the imitated ones (Q-filter, Nair et al., arXiv 1709.10089)."""
        pairs = [th.cat([features, either], dim=1) for either in (actions, own)]
        imitated_value, own_value = self.critic.project(th.cat(pairs)).mean(-1, keepdim=True).chunk(2, dim=-2)
        gain = imitated_value - own_value
        if self.policy.n_critics > 1:
            gain = gain.amax(0)
        is_imitated = gain >= 0
        self.diagnostics.follow(imitated_share=lambda: is_imitated.float().mean())
        return th.where(is_imitated, actions, th.lerp(own, actions, weight))

    def update_critic(self, batch: Batch) -> None:
        """All critics settle on the same targets, ΔΘ_c = e φ(z)ᵀ (lines 21 and 22). Without a weight they have no role."""
        if not self.has_critic_term:
            return
        targets = self.critic_targets(batch)
        state = self.critic.settle(th.cat([batch.features, batch.actions], dim=1), targets)
        self.diagnostics.settled("critic", state)
        self.critic.apply_changes(self.critic.hebbian_update(state))

    def update_generator(self, batch: Batch) -> None:
        """The epistemic signal learns the next observation (line 24). Without weight in the reward it has no role."""
        if self.used_weights.epistemic:
            self.epistemic.update(batch)

    def critic_targets(self, batch: Batch) -> th.Tensor:
        """t = r + γ c, or r alone when terminal; one and the same reward for every action output, (B, A)."""
        # The action taken (main text), or the target actor's next one with clipped noise as in TD3 (appendix)
        next_actions = batch.actions
        if self.target_policy_noise is not None:
            next_actions = self.actor_target.project(batch.bootstrap_features, batch.next_memory)
        if self.target_policy_noise:
            noise = th.randn_like(next_actions) * self.target_policy_noise
            bound = TARGET_NOISE_CLIP * self.target_policy_noise
            next_actions = (next_actions + noise.clamp(-bound, bound)).clamp(-1.0, 1.0)
        # c = f_proj([a, o]): of an ensemble the smaller value of two critics, drawn at random
        n_critics = self.policy.n_critics
        pair = th.randperm(n_critics)[:2] if n_critics > 2 else None
        values = self.critic_target.project(th.cat([batch.bootstrap_features, next_actions], dim=1), members=pair)
        if n_critics > 1:
            values = values.amin(0)
        return batch.rewards + (1.0 - batch.dones) * batch.discounts * values

    def update_targets(self) -> None:
        """The target circuits move towards the circuits by τ (1 copies)."""
        self.actor_target.move_towards(self.actor.circuit, self.tau)
        self.critic_target.move_towards(self.critic, self.tau)

    def _on_step(self) -> None:
        """Moves the targets where that goes by environment steps."""
        interval = self.target_update_interval
        now = self.num_timesteps
        if interval > 1 and now // interval > (now - self.n_envs) // interval:
            self.update_targets()
