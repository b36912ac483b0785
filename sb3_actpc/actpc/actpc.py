"""ActPC: active predictive coding as a Stable-Baselines3 algorithm (Ororbia & Mali, arXiv 2209.09174, Algorithm 1)."""

import warnings
from collections.abc import Callable, Iterable
from functools import reduce
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_actpc.actpc.arguments import check_keywords
from sb3_actpc.actpc.buffers import _SignalReplay, combined_buffer_class
from sb3_actpc.actpc.demonstration_replay import DemonstrationReplay
from sb3_actpc.actpc.diagnostics import Diagnostics
from sb3_actpc.actpc.features import Batch, CircuitInputs
from sb3_actpc.actpc.policies import ActPCActor, ActPCPolicy, CnnPolicy, Critics, MlpPolicy, MultiInputPolicy
from sb3_actpc.actpc.reward_signals import make_normalizer, summed_squared_errors
from sb3_actpc.actpc.self_imitation import Episodes, map_observations, sample_union
from sb3_actpc.checkpoints import Restored, between_updates, load_checkpoint, load_weights, save_weights
from sb3_actpc.demonstrations import fit_demonstrations
from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.ngc import HebbianChanges, NGCCircuit, settle_coupled
from sb3_actpc.utils.checks import check_finite, named_in_errors

SelfActPC = TypeVar("SelfActPC", bound="ActPC")

# of the mean absolute action-value that ``scale_pressure`` divides by: one paid step. Where nothing was paid yet, the critic's
# noise must not be blown up to full strength
SMALLEST_VALUE_SCALE = 1.0
EXPERT_SIGNALS_INTERVAL = 1000  # updates between two evaluations of the demonstrations' signals


class ActPC(OffPolicyAlgorithm):
    """
    Active predictive coding: four NGC circuits that learn by settling and Hebbian changes, never by backprop.

    The actor acts; the critic values its actions; the generator's surprise is an epistemic reward; the prior, learned from
    demonstrations and then frozen, gives an instrumental one. Paper: https://arxiv.org/abs/2209.09174. Defaults are the
    paper's (its tables for HalfCheetah) except where a comment at the constructor says otherwise, and for the error synapses,
    which are tied unless ``circuit_kwargs=dict(feedback="learned")`` asks for the paper's. Without demonstrations
    there is no prior, and the task's reward takes its role.

    :param policy: "MlpPolicy", "MultiInputPolicy", "CnnPolicy" (fixed random convolutions) or a class
    :param env: the environment, or its id
    :param learning_rate: of all circuits, or a schedule; circuits can have their own (``actor_kwargs`` and so on)
    :param buffer_size: transitions in the replay buffer
    :param learning_starts: environment steps with random actions before anything is learned
    :param batch_size: of all circuits; circuits can have their own
    :param tau: Polyak rate of the targets
    :param gamma: discount
    :param train_freq: environment steps (or episodes) between updates
    :param gradient_steps: updates each time; -1 for as many as steps were collected
    :param action_noise: exploration noise added to the action; the paper has none
    :param replay_buffer_class: None, or one of SB3's classes or its name (its ActPC counterpart is used)
    :param replay_buffer_kwargs: keywords of the buffer
    :param optimize_memory_usage: as in SB3
    :param n_steps: length of n-step returns
    :param settling: "iterative" (the paper) or "scheduled" (cheaper, numerically backprop without autograd)
    :param circuit_kwargs: further keywords of every :class:`~sb3_actpc.ngc.NGCCircuit` (``n_settling_steps``, ``feedback``,
        ``dynamics``, ``activation``, ``synaptic_scaling``, ...)
    :param actor_kwargs: the same for the actor alone, and its ``net_arch``, ``learning_rate`` and ``batch_size``
    :param critic_kwargs: the same for the critic
    :param generator_kwargs: the same for the generator
    :param prior_kwargs: the same for the prior
    :param demonstrations: a path, or a :class:`~sb3_actpc.demonstrations.dataset.Demonstrations`
    :param n_demonstrations: use only the first so many episodes of them
    :param n_demonstration_transitions: use only the first so many transitions (the paper's "300 samples")
    :param prior_updates: updates of the prior on the demonstrations before learning starts; then it is frozen
    :param actor_warm_start: updates of the actor on the demonstrations before learning starts
    :param refresh_weight: weight of the actor's refresh from the demonstrations and its own best episodes
    :param refresh_noise: standard deviation of Gaussian noise on the features (normalised observations) that refresh and warm
        start imitate on, not on the working memory's; against overfitting to few demonstrations. 0 for none (the paper)
    :param self_imitation_size: transitions in the memory of the agent's own best episodes; 0 for none
    :param demonstration_fraction: share of the critic's batch that comes from the demonstrations
    :param alpha_ep: weight of the epistemic signal
    :param alpha_in: weight of the instrumental signal
    :param alpha_ext: weight of the task's reward; by default 0 with demonstrations (the paper) and 1 without
    :param signal_normalizer: "max" (running maximum, the paper), "saturating" (r / (r + 1)) or "quantile"
    :param signal_errors: the signals sum the squared errors of "all" layers (the paper) or of the "output" alone
    :param actor_pressure: weight of the critic's pressure on the actor; 0 leaves refresh alone (cloning)
    :param scale_pressure: divide the pressure by the batch's mean absolute action-value (at least 1: one paid step)
    :param nudge: scale of the critic's clamped error while actor and critic settle as one (the paper's is 1); None for an
        infinitesimal one, or 1 with ``dynamics="state"``
    :param critic_warmup: updates before the critic's pressure reaches the actor
    :param n_critics: critic circuits; with two or more the smallest target value bootstraps
    :param bootstrap: "joint" (target critic at the target actor's next action, the appendix) or "literal" (at the action
        taken, the main text's equation)
    :param target_policy_noise: standard deviation of the noise on the target actor's action; 0 for none
    :param target_noise_clip: its bound
    :param target_update: "polyak" (every update) or "hard" (a copy every ``target_update_interval`` transitions)
    :param target_update_interval: C
    :param combined_replay: the newest transition of every environment is in every batch
    :param working_memory: feed actor, generator and prior the last ``memory_history`` observations
    :param memory_history: H
    :param observation_normalization: "none" (the paper) or "demonstrations" (their mean and standard deviation, fixed)
    :param policy_kwargs: further keywords of :class:`~sb3_actpc.actpc.policies.ActPCPolicy`
    :param stats_window_size: as in SB3
    :param tensorboard_log: as in SB3
    :param verbose: as in SB3
    :param device: as in SB3
    :param seed: as in SB3
    :raises ValueError: for a keyword with a value that is not allowed, for action spaces that are not Boxes, for
        demonstrations that do not fit the environment
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: ActPCPolicy
    replay_buffer: _SignalReplay | None
    actor: ActPCActor
    critic: Critics
    critic_target: Critics
    generator: NGCCircuit
    prior: NGCCircuit
    actor_target: NGCCircuit

    def __init__(
        self,
        policy: str | type[ActPCPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 4e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,  # the paper's 0.05 to 0.15 chases its own tail when the task's reward counts
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | str | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        *,
        settling: str = "iterative",
        circuit_kwargs: dict[str, Any] | None = None,
        actor_kwargs: dict[str, Any] | None = None,
        critic_kwargs: dict[str, Any] | None = None,
        generator_kwargs: dict[str, Any] | None = None,
        prior_kwargs: dict[str, Any] | None = None,
        demonstrations: Demonstrations | str | Path | None = None,
        n_demonstrations: int | None = None,
        n_demonstration_transitions: int | None = None,
        prior_updates: int = 2000,
        actor_warm_start: int = 0,
        refresh_weight: float = 1.0,
        refresh_noise: float = 0.0,
        self_imitation_size: int = 100_000,
        demonstration_fraction: float = 0.0,
        alpha_ep: float = 1.0,
        alpha_in: float = 1.0,
        alpha_ext: float | None = None,
        signal_normalizer: str = "max",
        signal_errors: str = "all",
        actor_pressure: float = 1.0,
        scale_pressure: bool = False,
        nudge: float | None = None,
        critic_warmup: int = 0,
        n_critics: int = 1,
        bootstrap: str = "joint",
        target_policy_noise: float = 0.0,
        target_noise_clip: float = 0.5,
        target_update: str = "polyak",
        target_update_interval: int = 500,
        combined_replay: bool = True,
        working_memory: bool = False,
        memory_history: int = 7,
        observation_normalization: str = "none",
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        device: th.device | str = "auto",
        seed: int | None = None,
        _init_setup_model: bool = True,
    ) -> None:
        check_keywords(locals(), self.policy_aliases)
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,  # type: ignore[arg-type]
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            supported_action_spaces=(spaces.Box,),
            support_multi_env=True,
        )
        self.settling = settling
        self.circuit_kwargs = circuit_kwargs
        self.actor_kwargs = actor_kwargs
        self.critic_kwargs = critic_kwargs
        self.generator_kwargs = generator_kwargs
        self.prior_kwargs = prior_kwargs
        # a path is kept absolute, so that the saved agent finds its demonstrations from any folder
        self.demonstrations = Path(demonstrations).absolute() if isinstance(demonstrations, (str, Path)) else demonstrations
        self.n_demonstrations = n_demonstrations
        self.n_demonstration_transitions = n_demonstration_transitions
        self.prior_updates = prior_updates
        self.actor_warm_start = actor_warm_start
        self.refresh_weight = refresh_weight
        self.refresh_noise = refresh_noise
        self.self_imitation_size = self_imitation_size
        self.demonstration_fraction = demonstration_fraction
        self.alpha_ep = alpha_ep
        self.alpha_in = alpha_in
        self.alpha_ext = alpha_ext
        self.signal_errors = signal_errors
        self.actor_pressure = actor_pressure
        self.scale_pressure = scale_pressure
        self.nudge = nudge
        self.critic_warmup = critic_warmup
        self.n_critics = n_critics
        self.bootstrap = bootstrap
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip
        self.target_update = target_update
        self.target_update_interval = target_update_interval
        self.combined_replay = combined_replay
        self.working_memory = working_memory
        self.memory_history = memory_history
        self.observation_normalization = observation_normalization
        self.signal_normalizer = signal_normalizer
        self.epistemic_normalizer = make_normalizer(signal_normalizer)
        self.instrumental_normalizer = make_normalizer(signal_normalizer)
        self.pretrained, self.n_pretraining_updates = False, 0
        if _init_setup_model:
            self._setup_model()

    # ------------------------------------------------------------------ setting up

    def _setup_model(self) -> None:
        if not np.all(np.isfinite([self.action_space.low, self.action_space.high])):  # type: ignore[attr-defined]
            raise ValueError(f"action_space={self.action_space} must have finite bounds; wrap the environment to rescale it")
        asked = self.replay_buffer_class, self.replay_buffer_kwargs, self.policy_kwargs, self.n_steps
        self.replay_buffer_class = combined_buffer_class(self.replay_buffer_class, self.observation_space, self.n_steps)
        self.replay_buffer_kwargs = {
            "combined": self.combined_replay,
            "history": self.history,
            "self_imitation_size": self.self_imitation_size,
            "n_steps": self.n_steps,
            "gamma": self.gamma,
            **self.replay_buffer_kwargs,
        }
        self.policy_kwargs = self._merged_policy_kwargs()
        self.n_steps = 1  # the buffer knows; SB3 would warn that a custom one does not
        # SB3 checks by assertion what does not go together
        with named_in_errors(f"buffer_size={self.buffer_size}, replay_buffer_kwargs={asked[1]!r}", ValueError, AssertionError):
            super()._setup_model()
        self.replay_buffer_kwargs, self.policy_kwargs, self.n_steps = asked[1:]
        self._create_aliases()
        self._setup_demonstrations()
        self.diagnostics = Diagnostics(self.policy)

    def _merged_policy_kwargs(self) -> dict[str, Any]:
        own = {
            "n_critics": self.n_critics,
            "memory_history": self.history,
            **{f"{name}_kwargs": getattr(self, f"{name}_kwargs") for name in ("actor", "critic", "generator", "prior")},
        }
        merged = {**own, **self.policy_kwargs}
        given = {**(self.circuit_kwargs or {}), **(merged.get("circuit_kwargs") or {})}
        chosen = given.get("settling", self.settling)
        if not isinstance(chosen, str) or chosen != self.settling:
            raise ValueError(f"circuit_kwargs has settling={chosen!r} but the agent's is {self.settling!r}; pass settling=")
        merged["circuit_kwargs"] = {**given, "settling": self.settling}
        return merged

    @property
    def history(self) -> int:
        """Observations in the working memory; 0 without one."""
        return self.memory_history if self.working_memory else 0

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.critic = self.policy.critic
        self.generator = self.policy.generator
        self.prior = self.policy.prior
        self.actor_target = self.policy.actor_target
        self.critic_target = self.policy.critic_target

    def _setup_demonstrations(self) -> None:
        """Check the demonstrations against the environment, cut them, and derive what follows from having them."""
        self.expert: DemonstrationReplay | None = None
        if self.demonstrations is None:
            names = "demonstration_fraction actor_warm_start n_demonstrations n_demonstration_transitions".split()
            idle = [name for name in names if getattr(self, name)]
            idle += ["observation_normalization"] if self.observation_normalization == "demonstrations" else []
            if idle:
                raise ValueError(f"{' and '.join(idle)} need demonstrations=; pass a file or leave them out")
            return
        if self.env is None and isinstance(self.observation_space, spaces.Dict):
            return  # only a goal task can turn the demonstrations into its own: ``set_env`` tries again
        limits = self.n_demonstrations, self.n_demonstration_transitions
        try:
            demonstrations = fit_demonstrations(
                self.demonstrations, self.env, self.observation_space, self.action_space, *limits
            )
        except FileNotFoundError:
            if not self.pretrained:
                raise
            return  # a trained agent acts without them; ``learn`` says what is missing
        assert isinstance(self.action_space, spaces.Box)
        self.expert = DemonstrationReplay(demonstrations, self.observation_space, self.action_space, self.history)
        if self.observation_normalization == "demonstrations" and not self.pretrained:
            observations = self.inputs.observations(self.expert.episodes.observations)
            self.actor.normalizer.fit(self.inputs.features(observations))

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        super().set_env(env, force_reset)
        if self.demonstrations is not None:  # another environment may pay for other steps
            self._setup_demonstrations()

    @property
    def inputs(self) -> CircuitInputs:
        """Turns observations into what the circuits see."""
        return CircuitInputs(self.actor, self._vec_normalize_env)

    @property
    def reward_weights(self) -> tuple[float, float, float]:
        """(α_ext, α_ep, α_in) as used: without demonstrations there is no prior and the task's reward takes its role."""
        if self.demonstrations is not None:
            return (0.0 if self.alpha_ext is None else self.alpha_ext), self.alpha_ep, self.alpha_in
        return (1.0 if self.alpha_ext is None else self.alpha_ext), self.alpha_ep, 0.0

    # ------------------------------------------------------------------ before learning: prior and warm start

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps or self._last_obs is None:  # SB3 resets the environments
            self._rollout_state: tuple[np.ndarray, ...] | None = None
            self._rollout_starts = np.ones(self.n_envs, dtype=bool)
            if self.replay_buffer is not None:
                self.replay_buffer.cut_running_episodes()
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        self._check_observations(self._last_obs)
        self.pretrain(between_updates(result[1]))
        return result

    def pretrain(self, before_update: Callable[[], None] = lambda: None) -> None:
        """
        Train the prior (and, if asked for, the actor) on the demonstrations, once; ``learn`` calls this.

        :param before_update: called before each update
        :raises ValueError: when the demonstrations of a loaded agent are not there any more
        """
        if self.expert is None and self.demonstrations is not None:
            raise ValueError(f"no demonstrations file at {self.demonstrations}: set agent.demonstrations, or put it back")
        if self.pretrained or self.expert is None:
            return
        if self._vec_normalize_env is not None and self._vec_normalize_env.norm_obs:
            warnings.warn(
                "VecNormalize's observation statistics drift under the frozen prior: use VecNormalize(norm_obs=False) with "
                "observation_normalization='demonstrations'",
                stacklevel=2,
            )
        n_prior = self.prior_updates if self.alpha_in else 0  # without a weight the prior has no role
        for update in range(self.n_pretraining_updates, n_prior + self.actor_warm_start):
            before_update()
            if update < n_prior:
                self._update_prior(self.policy.batch_size_of("prior", self.batch_size))
            else:
                self.actor.circuit.apply_changes(self._refresh_changes(), self.actor.circuit.optimizer)
            self.n_pretraining_updates += 1
        self.actor_target.load_state_dict(self.actor.circuit.state_dict())
        self.pretrained = True

    def _update_prior(self, batch_size: int) -> None:
        assert self.expert is not None
        batch = self.expert.sample(batch_size, self.inputs, self.reward_weights, self.gamma)
        state = self.prior.settle(batch.features, batch.next_features, batch.memory)
        self.prior.apply_changes(self.prior.hebbian_update(state), self.prior.optimizer)

    # ------------------------------------------------------------------ collecting

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        warming_up = self.num_timesteps < learning_starts
        if self.history or not warming_up:  # the working memory follows random actions too
            assert self._last_obs is not None
            unscaled, self._rollout_state = self.policy.predict(self._last_obs, self._rollout_state, self._rollout_starts)
        if warming_up:
            unscaled = np.array([self.action_space.sample() for _ in range(n_envs)])
        scaled = self.policy.scale_action(unscaled)
        check_finite("actor", "actions", scaled, self.num_timesteps)
        if action_noise is not None:
            scaled = np.clip(scaled + action_noise(), -1.0, 1.0)
        return self.policy.unscale_action(scaled), scaled

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        self._check_observations(new_obs)
        for info in infos:
            if "terminal_observation" in info:
                self._check_observations(info["terminal_observation"])
        check_finite("environment", "rewards", reward, self.num_timesteps)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self._rollout_starts = np.array(dones, dtype=bool)
        self._compute_newest_signals()

    def _check_observations(self, observations: Any) -> None:
        map_observations(lambda array: check_finite("environment", "observations", array, self.num_timesteps), observations)

    def _compute_newest_signals(self) -> None:
        """The signals of the transitions just stored (Algorithm 1, lines 10 to 13)."""
        _, alpha_ep, alpha_in = self.reward_weights
        if not (alpha_ep or alpha_in):
            return
        assert self.replay_buffer is not None
        newest = self.replay_buffer.newest_transitions(self._vec_normalize_env)
        features, next_features = map(self.inputs.features, (newest.observations, newest.next_observations))
        memory = self.inputs.memory(newest.history, newest.history_mask)
        raw_ep, raw_in = self._raw_signals(features, newest.actions, next_features, memory)
        epistemic = self.epistemic_normalizer(raw_ep) if alpha_ep else raw_ep
        instrumental = -self.instrumental_normalizer(raw_in) if alpha_in else raw_in
        check_finite("generator", "signals", epistemic, self.num_timesteps)
        check_finite("prior", "signals", instrumental, self.num_timesteps)
        self.replay_buffer.set_newest_signals(epistemic, instrumental)
        self.diagnostics.follow(epistemic_signal=epistemic.mean(), instrumental_signal=instrumental.mean())

    def _raw_signals(
        self, features: th.Tensor, actions: th.Tensor, next_features: th.Tensor, memory: th.Tensor | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Summed squared errors of generator and prior, (B,) each; zeros where the signal has no weight."""
        _, alpha_ep, alpha_in = self.reward_weights
        epistemic, instrumental = np.zeros((2, len(features)), dtype=np.float32)
        if alpha_ep:
            state = self.generator.settle(th.cat([features, actions], dim=1), next_features, memory)
            epistemic = summed_squared_errors(state, self.signal_errors).cpu().numpy()
        if alpha_in:
            state = self.prior.settle(features, next_features, memory)
            self.diagnostics.settled("prior", state)
            instrumental = summed_squared_errors(state, self.signal_errors).cpu().numpy()
        return epistemic, instrumental

    # ------------------------------------------------------------------ learning

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """
        The updates of Algorithm 1 (lines 15 to 23), ``gradient_steps`` times.

        :param gradient_steps: how many updates of every circuit
        :param batch_size: B
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate([circuit.optimizer for _, circuit in self.policy.named_circuits()])
        for _ in range(gradient_steps):
            self._n_updates += 1
            self.diagnostics.begin_update(self._n_updates, self.num_timesteps)
            batch = self._sample_batch(batch_size)
            self._update_actor(batch)
            self._update_critic(batch)
            self._update_generator(batch)
            if self.target_update == "polyak":
                self._update_targets(self.tau)
        self._log_training()

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        """SB3's schedule, times what each parameter group asks for (γ_e, a circuit's own learning rate)."""
        super()._update_learning_rate(optimizers)
        for optimizer in optimizers if isinstance(optimizers, Iterable) else [optimizers]:
            for group in optimizer.param_groups:
                group["lr"] *= group["lr_scale"]

    def _sample_batch(self, batch_size: int) -> Batch:
        """Replayed transitions, the newest among them, then the share that comes from the demonstrations."""
        assert self.replay_buffer is not None
        sizes = [self.policy.batch_size_of(name, batch_size) for name in ("actor", "critic", "generator")]
        batch_size = max(sizes)
        n_expert = round(self.demonstration_fraction * batch_size) if self.expert is not None else 0
        replayed = self.replay_buffer.sample(batch_size - n_expert, env=self._vec_normalize_env)
        inputs, weights = self.inputs, self.reward_weights
        features = inputs.features(replayed.observations)
        pasts = replayed.history, replayed.history_mask, features, replayed.next_history, replayed.next_history_mask
        memory, next_memory = inputs.memories(*pasts)
        next_features = bootstrap_features = inputs.features(replayed.next_observations)
        if replayed.following_observations is not None:
            next_features = inputs.features(replayed.following_observations)
        internal = weights[1] * replayed.epistemic + weights[2] * replayed.instrumental
        self.diagnostics.follow(internal_reward=internal.mean, task_reward=replayed.rewards.mean)
        batch = Batch(
            features=features,
            actions=replayed.actions,
            next_features=next_features,
            bootstrap_features=bootstrap_features,
            memory=memory,
            next_memory=next_memory,
            rewards=weights[0] * replayed.rewards + internal,
            dones=replayed.dones,
            discounts=th.full_like(replayed.dones, self.gamma) if replayed.discounts is None else replayed.discounts,
        )
        if n_expert and self.expert is not None:
            if any(weights[1:]) and (self._n_updates % EXPERT_SIGNALS_INTERVAL == 1 or not self.expert.has_signals):
                normalizers = self.epistemic_normalizer, self.instrumental_normalizer
                self.expert.refresh_signals(self._raw_signals, inputs, *normalizers)
            batch = batch.join(self.expert.sample(n_expert, inputs, weights, self.gamma, self.n_steps))
        if min(sizes) == batch_size:
            return batch
        # circuits with a smaller batch take its first rows: the newest, then a fair mixture of the rest
        return batch.shuffled(keep=self.n_envs if self.combined_replay else 0)

    def _update_actor(self, batch: Batch) -> None:
        """Motor-action circuit: pressure of the critic (line 17) plus refresh (line 23), in one step of the optimiser."""
        changes = self._refresh_changes() if self.refresh_weight and self._imitated() else None
        if changes is not None:
            self.diagnostics.change_norms("refresh", changes.scale_(self.refresh_weight))
        if self.actor_pressure and self._n_updates > self.critic_warmup:
            rows = slice(self.policy.batch_size_of("actor", self.batch_size))
            memory = None if batch.memory is None else batch.memory[rows]
            coupled = settle_coupled(self.actor.circuit, self.critic.first(), batch.features[rows], memory, self.nudge)
            pressure = self.actor.circuit.hebbian_update(coupled.actor)
            weight: float | th.Tensor = self.actor_pressure
            if self.scale_pressure:
                weight = weight / coupled.action_values.abs().mean().clamp_min(SMALLEST_VALUE_SCALE)
            self.diagnostics.coupled(coupled, pressure, batch.features[rows], memory)
            if changes is None:
                self.diagnostics.settled("actor", coupled.actor)
            self.diagnostics.change_norms("pressure", pressure.scale_(weight))
            changes = pressure if changes is None else changes.add_(pressure)
        if changes is not None:
            self.actor.circuit.apply_changes(changes, self.actor.circuit.optimizer)

    def _update_critic(self, batch: Batch) -> None:
        """Policy circuit(s): settle on the bootstrapped targets (lines 19 and 20)."""
        rows = slice(self.policy.batch_size_of("critic", self.batch_size))
        inputs = th.cat([batch.features, batch.actions], dim=1)[rows]
        targets = self._critic_targets(batch)[rows]
        for index, critic in enumerate(self.critic):
            state = critic.settle(inputs, targets)
            critic.apply_changes(critic.hebbian_update(state), critic.optimizer)
            self.diagnostics.settled(f"critic.{index}" if index else "critic", state)

    def _critic_targets(self, batch: Batch) -> th.Tensor:
        """t = r + γ c, or r alone when terminal; one and the same reward for every action output, (B, A)."""
        if self.bootstrap == "literal":
            next_actions = batch.actions
        else:
            next_actions = self.actor_target.project(batch.bootstrap_features, batch.next_memory)
            if self.target_policy_noise:
                noise = th.randn_like(next_actions) * self.target_policy_noise
                next_actions = (next_actions + noise.clamp(-self.target_noise_clip, self.target_noise_clip)).clamp(-1.0, 1.0)
        inputs = th.cat([batch.bootstrap_features, next_actions], dim=1)
        first, *others = (critic.project(inputs) for critic in self.critic_target)
        values = reduce(th.minimum, others, first)
        return batch.rewards + (1.0 - batch.dones) * batch.discounts * values

    def _update_generator(self, batch: Batch) -> None:
        """World model: settle on the next observation (line 21). Without weight in the reward it has no role."""
        if not self.alpha_ep:
            return
        rows = slice(self.policy.batch_size_of("generator", self.batch_size))
        inputs = th.cat([batch.features[rows], batch.actions[rows]], dim=1)
        state = self.generator.settle(inputs, batch.next_features[rows], None if batch.memory is None else batch.memory[rows])
        self.generator.apply_changes(self.generator.hebbian_update(state), self.generator.optimizer)
        self.diagnostics.settled("generator", state)

    def _update_targets(self, tau: float) -> None:
        """Move the target circuits by ``tau`` (1 copies)."""
        for target, circuit in zip([self.actor_target, *self.critic_target], [self.actor.circuit, *self.critic], strict=True):
            for mine, theirs in zip(target.synapses, circuit.synapses, strict=True):
                if mine:
                    th._foreach_lerp_(mine, theirs, tau)

    def _on_step(self) -> None:
        """A hard copy of the targets every ``target_update_interval`` transitions."""
        if self.target_update == "hard":
            interval, now = self.target_update_interval, self.num_timesteps
            if now // interval > (now - self.n_envs) // interval:
                self._update_targets(1.0)

    # ------------------------------------------------------------------ demonstrations and self-imitation

    def _imitated(self) -> list[Episodes]:
        """What refresh draws from: the demonstrations and the self-imitation memory."""
        assert self.replay_buffer is not None
        memory = self.replay_buffer.self_imitation
        own = [memory.episodes] if memory is not None and len(memory) else []
        return own if self.expert is None else [self.expert.episodes, *own]

    def _refresh_changes(self) -> HebbianChanges:
        """Settle the actor on imitated actions."""
        inputs, n = self.inputs, self.policy.batch_size_of("actor", self.batch_size)
        samples = sample_union(self._imitated(), n, self.history)
        features = inputs.features(inputs.observations(samples.observations))
        if self.refresh_noise:
            features = features + self.refresh_noise * th.randn_like(features)
        memory = inputs.memory(*inputs.past(samples.history, samples.history_mask))
        state = self.actor.circuit.settle(features, inputs.tensor(samples.actions), memory)
        self.diagnostics.settled("actor", state)
        return self.actor.circuit.hebbian_update(state)

    # ------------------------------------------------------------------ logging, saving

    def _log_training(self) -> None:
        assert self.replay_buffer is not None
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for key, value in self.diagnostics.summary().items():
            self.logger.record(f"train/{key}", value)
        memory = self.replay_buffer.self_imitation
        if memory is not None:
            self.logger.record("train/self_imitation_size", len(memory))
            self.logger.record("train/self_imitation_best_return", memory.best_return)

    def learn(
        self: SelfActPC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "ActPC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfActPC:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint (:mod:`sb3_actpc.checkpoints`) keeps beside SB3's state: plain values and arrays."""
        expert = self.expert
        return {
            "pretrained": self.pretrained,
            "n_pretraining_updates": self.n_pretraining_updates,
            "rollout_state": self._rollout_state,
            "rollout_starts": self._rollout_starts,
            "normalizers": [dict(vars(self.epistemic_normalizer)), dict(vars(self.instrumental_normalizer))],
            "expert_signals": None if expert is None else [expert.epistemic, expert.instrumental, expert.has_signals],
            "diagnostics": dict(self.diagnostics.values),
        }

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """
        :param state: what :meth:`checkpoint_state` returned
        :raises ValueError: when it was taken with other demonstrations
        """
        signals = state["expert_signals"]
        stored, present = (0 if signals is None else len(signals[0])), (0 if self.expert is None else len(self.expert))
        if stored != present:
            raise ValueError(
                f"the checkpoint's agent has {stored} demonstrated transitions, this one {present}: pass the same "
                "demonstrations="
            )
        if self.expert is not None:
            self.expert.epistemic, self.expert.instrumental, self.expert.has_signals = signals
        self.pretrained, self.n_pretraining_updates = state["pretrained"], state["n_pretraining_updates"]
        self._rollout_state, self._rollout_starts = state["rollout_state"], state["rollout_starts"]
        normalizers = self.epistemic_normalizer, self.instrumental_normalizer
        for normalizer, values in zip(normalizers, state["normalizers"], strict=True):
            vars(normalizer).update(values)
        self.diagnostics.values = dict(state["diagnostics"])

    @classmethod
    def load_checkpoint(cls: type[SelfActPC], path: str | PathLike[str], env: GymEnv | str, **keywords: Any) -> Restored:
        """
        Go on from a checkpoint: see :func:`sb3_actpc.checkpoints.load_checkpoint` and ``continue_learning`` there.

        :param path: a checkpoint, or the folder of several: the newest whole one is taken
        :param env: an environment made as the stopped run's
        :param keywords: constructor keywords that replace the stored ones, such as ``demonstrations``
        """
        return load_checkpoint(cls, path, env, **keywords)

    def save_weights(self, path: str | PathLike[str]) -> Path:
        """
        Write weights and settings into a file that cannot run code: see :func:`sb3_actpc.checkpoints.save_weights`.

        :param path: file to write; ``.safetensors`` is added where it is missing
        :return: the file
        """
        return save_weights(self, path)

    @classmethod
    def from_weights(cls: type[SelfActPC], path: str | PathLike[str], env: GymEnv | str, **keywords: Any) -> SelfActPC:
        """
        An agent from a file of :meth:`save_weights`: see :func:`sb3_actpc.checkpoints.load_weights`.

        :param path: the file
        :param env: the environment, or its id
        :param keywords: constructor keywords that replace the stored ones; ``demonstrations`` are not in the file
        """
        with_demonstrations = keywords.get("demonstrations") is not None
        needing = () if with_demonstrations else ("observation_normalization", "demonstration_fraction", "actor_warm_start")
        model = load_weights(cls, path, env, without=needing, **keywords)
        model.pretrained = True  # the weights hold what the demonstrations taught
        return model

    def _excluded_save_params(self) -> list[str]:
        aliases = ["actor", "critic", "generator", "prior", "actor_target", "critic_target"]
        derived = ["expert", "diagnostics"]
        return [*super()._excluded_save_params(), *aliases, *derived]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names = [name if name != "actor" else "actor.circuit" for name, _ in self.policy.named_circuits()]
        return ["policy", *(f"policy.{name}.optimizer" for name in names)], []
