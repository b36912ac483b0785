"""What stands between SB3 and Algorithm 1: the agent's parts, its demonstrations, its batches, and its files."""

import time
import warnings
from collections.abc import Iterable, Iterator
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, TrainFreq, TrainFrequencyUnit
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.actpc.batches import Batch, SignalReplaySamples, minibatches, normalized, to_device
from sb3_actpc.actpc.buffers import SignalReplay, combined_buffer_class
from sb3_actpc.actpc.demonstration_replay import PART, DemonstrationReplay
from sb3_actpc.actpc.diagnostics import Diagnostics
from sb3_actpc.actpc.policies import ActPCActor, ActPCPolicy
from sb3_actpc.actpc.reward_signals import InternalSignals, RewardWeights, check_reward_weights
from sb3_actpc.actpc.self_imitation import Episodes, sample_union
from sb3_actpc.actpc.validation import check_loaded_buffer, check_observations, finite_bounds
from sb3_actpc.checkpoints import Restored, load_checkpoint
from sb3_actpc.demonstrations.mixin import LearnsFromDemonstrations
from sb3_actpc.guidance import ActorGuidance, GuidanceContext
from sb3_actpc.guidance.base import ImitationBatch
from sb3_actpc.guidance.guidance import make_guidance
from sb3_actpc.utils.arguments import check_noise
from sb3_actpc.utils.checks import Settings, check_finite, named_in_errors
from sb3_actpc.utils.noise import as_action_noise
from sb3_actpc.utils.rollouts import StoresLastTransition
from sb3_actpc.utils.weights import load_weights, save_weights

SelfBase = TypeVar("SelfBase", bound="ActPCBase")
RESCORING_INTERVAL = 1000  # updates between two evaluations of the demonstrations' signals
MOST_MINIBATCHES = 64  # sampled at once
NEED_DEMONSTRATIONS = ("demonstration_fraction", "n_demonstrations")
_OF_POLICY = ("actor", "critic", "generator", "prior", "actor_target", "critic_target")
_DERIVED = ("expert", "diagnostics", "epistemic", "instrumental", "actor_guidance", "_used_demonstrations", "_described")


class ActPCBase(LearnsFromDemonstrations, StoresLastTransition):
    """
    What stands between SB3 and Algorithm 1: the agent's parts, its demonstrations, its batches, and its files.

    The attributes are :class:`~sb3_actpc.actpc.actpc.ActPC`'s, whose constructor documents them.
    """

    action_space: spaces.Box
    policy: ActPCPolicy
    actor: ActPCActor
    replay_buffer: SignalReplay
    signals: InternalSignals
    settling: str
    guidance: ActorGuidance | str
    guidance_kwargs: Settings | None
    signal_kwargs: Settings | None
    reward_weights: Settings
    target_policy_noise: float | None
    critic_weight: float | None
    refresh_weight: float
    policy_delay: int
    demonstration_fraction: float
    observation_normalization: str
    only_acts = False  # a bundled agent, whose critic is not trained
    expert: DemonstrationReplay | None = None  # the demonstrations, fitted to the environment
    was_made_without_demonstrations: bool
    made_with: Settings  # what the circuits depend on
    weighted_signals = (False, False)  # whether the epistemic and the instrumental signal of what is stored had a weight
    _used_demonstrations: tuple[Any, ...] = ()
    _described = ""  # what ``learn`` has said
    _rollout_state: tuple[np.ndarray, ...] | None = None  # the working memory of the running episodes
    _rollout_starts: np.ndarray  # (n_envs,), where an episode begins with the next step

    @property
    def is_pretrained(self) -> bool:
        """Whether the actor has imitated the demonstrations (:meth:`pretrain`), or was given synapses that have."""
        return bool(self.policy.has_imitated)

    @property
    def imitates_first(self) -> bool:
        """Whether ``learn`` begins with BC, so that an evaluation before it says nothing."""
        return self.demonstrations is not None and self.guidance != "none" and not self.is_pretrained

    @property
    def actor_policy(self) -> ActPCActor:
        """What the deployment gate may deploy next: by default the actor's moving average, without a gate the actor itself.
        For ``evaluate_policy(agent.actor_policy, env)``; ``predict`` uses the deployed policy."""
        return self.actor.with_circuit(self.actor_guidance.candidate(self._context()))

    @property
    def used_weights(self) -> RewardWeights:
        """The weights of the reward's parts; without demonstrations there is no prior."""
        weights = RewardWeights(**(self.reward_weights or {}))
        return weights if self.demonstrations is not None else weights._replace(instrumental=0.0)

    @property
    def has_critic_term(self) -> bool:
        """Whether the critic has a part in the actor's update; its own updates have no use without."""
        return self.critic_weight != 0

    # ------------------------------------------------------------------ parts

    def _setup_model(self) -> None:
        if self.action_space is None:
            raise ValueError("env=None: an environment or the id of one is needed, such as 'Pendulum-v1'")
        self._check_actions()
        self.actor_guidance = make_guidance(self.guidance, self.guidance_kwargs)
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self._make_policy().to(self.device)
        self.actor = self.policy.actor
        self.actor_target = self.policy.actor_target
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target
        self.generator = self.policy.generator
        self.prior = self.policy.prior
        self.diagnostics = Diagnostics(self.policy)
        # A loaded agent may be given other signals; of the same ones it keeps what their normalizers have seen
        with named_in_errors(f"signal_kwargs={self.signal_kwargs!r}"):
            signals = InternalSignals(**(self.signal_kwargs or {}))
        if signals.settings != self.signals.settings:
            self.signals = signals
        self.signals.prior_updates = signals.prior_updates
        self.epistemic = signals.epistemic_class(self.policy.generator, self.diagnostics, signals.errors)
        self.instrumental = signals.instrumental_class(self.policy.prior, self.diagnostics, signals.errors)
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        self._convert_train_freq()

    def _check_settings(self) -> None:
        """:raises ValueError: for settings, which can change after the agent was made, that do not go together"""
        check_reward_weights("reward_weights", self.reward_weights)
        check_noise("action_noise", self.action_noise)
        self.action_noise = as_action_noise(self.action_noise, self.action_space.shape)
        epistemic = self.used_weights.epistemic
        if epistemic and self.optimize_memory_usage:
            raise ValueError(
                f"reward_weights['epistemic']={epistemic:g} does not work with optimize_memory_usage=True, which overwrites "
                "the last observations of episodes: use optimize_memory_usage=False or a weight of 0"
            )
        self._convert_train_freq()  # that may have been set since
        assert isinstance(self.train_freq, TrainFreq)
        if self.train_freq.unit is TrainFrequencyUnit.EPISODE and self.n_envs > 1:
            raise ValueError(f"train_freq=({self.train_freq.frequency}, 'episode') needs one environment, not {self.n_envs}")
        if self.target_policy_noise is None and self.n_steps > 1:
            raise ValueError(
                f"n_steps={self.n_steps} does not work with target_policy_noise=None, which values the action taken: use 1"
            )
        if self.used_weights.instrumental and self.signals.prior_updates and not self.lr_schedule(1.0):
            raise ValueError(
                f"reward_weights['instrumental']={self.used_weights.instrumental:g}: the prior learns before the first step, "
                "at the learning rate's start value, which is 0: begin above"
            )
        for name in self.policy.circuits():
            own = self.policy.settings_of(name).get("learning_rate")
            if own and not self.lr_schedule(1.0):
                raise ValueError(
                    f"{name}_kwargs has learning_rate={own}, a multiple of the agent's, which begins at 0: begin above"
                )

    def _check_needs_met(self) -> None:
        """Warns of an actor that nothing teaches.

        :raises ValueError: for keywords that say nothing without demonstrations
        """
        needing = [name for name in NEED_DEMONSTRATIONS if getattr(self, name)]
        if self.observation_normalization == "demonstrations":
            needing.append("observation_normalization")
        if needing and self.demonstrations is None:
            raise ValueError(f"{' and '.join(needing)}: give demonstrations=, or leave it out")
        can_imitate = self.demonstrations is not None or self.replay_buffer_kwargs.get("self_imitation_size") != 0
        if not self.has_critic_term and not can_imitate:
            warnings.warn(
                "critic_weight=0 without demonstrations leaves the actor nothing to learn from: give demonstrations=, or a "
                "critic_weight above 0",
                stacklevel=4,
            )

    def _make_policy(self) -> ActPCPolicy:
        if "is_gated" in self.policy_kwargs:
            raise ValueError("policy_kwargs has is_gated, which guidance sets: use guidance_kwargs=dict(gate=...)")
        # A loaded agent has the circuits of its file
        made_with = {"settling": self.settling, "deployment gate": self.actor_guidance.has_gate}
        for name, stored in self.made_with.items():
            if made_with[name] != stored:
                raise ValueError(
                    f"the agent was made with {name} {stored!r}, on which its circuits depend, not {made_with[name]!r}: leave "
                    "settling, guidance and guidance_kwargs out"
                )
        self.made_with = made_with
        with named_in_errors(f"policy_kwargs={self.policy_kwargs!r}", ValueError, AssertionError):
            circuit_kwargs = {"settling": self.settling, **(self.policy_kwargs.get("circuit_kwargs") or {})}
            if circuit_kwargs["settling"] != self.settling:
                raise ValueError(f"circuit_kwargs has settling={circuit_kwargs['settling']!r}: give settling= to the agent")
            own = {"circuit_kwargs": circuit_kwargs, "is_gated": self.actor_guidance.has_gate}
            keywords = {**self.policy_kwargs, **own}
            policy = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **keywords)
        assert isinstance(policy, ActPCPolicy)
        return policy

    def _make_replay_buffer(self) -> SignalReplay:
        # With optimize_memory_usage the plain class refuses n-step returns by name
        n_steps = 1 if self.optimize_memory_usage else self.n_steps
        kind = combined_buffer_class(self.replay_buffer_class, self.observation_space, self.env, n_steps)
        kwargs: dict[str, Any] = {"history": self.policy.memory_history, "n_steps": self.n_steps, "gamma": self.gamma}
        if issubclass(kind, HerReplayBuffer):
            kwargs["env"] = self.env
        # SB3 checks by assertion what does not go together
        where = f"buffer_size={self.buffer_size}, replay_buffer_kwargs={self.replay_buffer_kwargs!r}"
        with named_in_errors(where, ValueError, AssertionError):
            return kind(
                self.buffer_size,
                self.observation_space,
                self.action_space,
                device=self.device,
                n_envs=self.n_envs,
                optimize_memory_usage=self.optimize_memory_usage,
                **kwargs,
                **self.replay_buffer_kwargs,
            )

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As in SB3. Returns of another environment are dropped; the next ``learn`` fits the demonstrations to it."""
        is_first = self.env is None
        super().set_env(env, force_reset)
        self.actor_guidance.forget_returns()
        self.expert = None
        if self.replay_buffer is not None and not is_first:
            self.replay_buffer.forget_own_episodes()
        if isinstance(self.replay_buffer, HerReplayBuffer):
            assert self.env is not None
            combined_buffer_class(self.replay_buffer_class, self.observation_space, self.env)  # checks compute_reward
            self.replay_buffer.env = self.env  # whose rewards relabelled transitions get

    # ------------------------------------------------------------------ demonstrations

    def _setup_demonstrations(self) -> None:
        """
        Fit the demonstrations to the environment, and the observation normalizer to them or to the bounds.

        :raises ValueError: for demonstrations that do not fit
        """
        self._used_demonstrations = self.demonstrations, self.n_demonstrations
        self.expert = None
        if self.demonstrations is not None:
            self.expert = DemonstrationReplay(
                self._fitted_demonstrations(), self.observation_space, self.action_space, self.policy.memory_history
            )
        # An actor that has imitated keeps the statistics of its demonstrations
        is_normalised = self.has_normalized_observations
        parts: Iterable[Any]
        if self.observation_normalization == "bounds":
            parts = [finite_bounds(self.observation_space, is_normalised)]
        elif self.observation_normalization == "demonstrations" and self.expert is not None and not self.is_pretrained:
            parts = [] if is_normalised else self.expert.parts()
        else:
            return
        extractor = self.actor.features_extractor
        seen = [self.actor.extract_features(to_device(part, self.device), extractor) for part in parts]
        self.actor.normalizer.fit(th.cat(seen) if seen else None)

    def _update_demonstrations(self) -> None:
        """Use demonstrations that were set since. A prior and a normalizer that have learned stay as they are."""
        if self.demonstrations is not None and self.guidance == "none" and self.was_made_without_demonstrations:
            self.was_made_without_demonstrations = False  # said once
            warnings.warn(
                "demonstrations were set after the agent was made without: guidance='none' "
                f"(no BC pre-training), n_steps={self.n_steps}, demonstration_fraction={self.demonstration_fraction:g} and "
                f"replay_buffer_kwargs={self.replay_buffer_kwargs!r} stay. For the defaults with "
                "demonstrations, pass demonstrations= to the constructor",
                stacklevel=5,
            )
        now = self.demonstrations, self.n_demonstrations
        if self.expert is None or any(mine is not one for mine, one in zip(now, self._used_demonstrations, strict=True)):
            self._setup_demonstrations()
        # one discount and one length of returns for what is replayed and what is demonstrated, of a loaded buffer too
        self.replay_buffer.set_returns(self.n_steps, self.gamma)
        memory = self.replay_buffer.self_imitation
        if memory is not None:
            # With negative returns steps are drawn uniformly, and mediocre episodes would outnumber the demonstrations
            expert = self.expert
            has_negative = expert is None or bool(expert.episodes.returns.min() < 0.0)
            memory.takes_all = self.actor_guidance.stores == "positive" and not has_negative
            memory.count_from(0.0 if expert is None else expert.failure_reward)
        if self.demonstrations is None:
            self._go_on_without_demonstrations()

    def _go_on_without_demonstrations(self) -> None:
        """Turn off what needs them, and warn of what was set and has no effect now."""
        self.demonstration_fraction = 0.0
        self.n_demonstrations = None
        if self.is_pretrained and self.refresh_weight:
            warnings.warn(
                "the agent learned from demonstrations and continues without them, from now on with demonstration_fraction=0: "
                "pass demonstrations=",
                stacklevel=6,
            )
        unused = (self.reward_weights or {}).get("instrumental")
        if unused:
            warnings.warn(f"reward_weights['instrumental']={unused:g} has no effect without demonstrations=", stacklevel=6)

    def pretrain(self) -> None:
        """Train the prior on the demonstrations and let guidance start, once; ``learn`` calls this."""
        if self.expert is None and self.demonstrations is not None:  # of a loaded agent
            self._setup_demonstrations()
        expert = self.expert
        env = self._vec_normalize_env
        if expert is not None:
            if not self.is_pretrained and env is not None and env.norm_obs and env.training:
                warnings.warn("VecNormalize's statistics drift while the circuits learn: use norm_obs=False", stacklevel=3)
                expert.show_to(env)  # it has seen one observation else
                if self._last_original_obs is not None:
                    self._last_obs = env.normalize_obs(self._last_original_obs)
            self._train_prior(expert)
        # BC is of demonstrations: an agent without does not imitate its own episodes first
        self._take_residual()
        self.actor_guidance.on_training_start(self._context(), self.is_pretrained or expert is None)
        if self.actor_guidance.bc_residual is not None:
            self.policy.bc_residual.fill_(self.actor_guidance.bc_residual)
            self._take_residual()
        if expert is not None:
            self.policy.has_imitated.fill_(1.0)

    def _take_residual(self) -> None:
        """What BC measured, which goes where the synapses go."""
        residual = float(self.policy.bc_residual)
        if residual >= 0.0:
            self.actor_guidance.bc_residual = residual

    def _train_prior(self, expert: DemonstrationReplay) -> None:
        """The updates that the prior has not had yet; without a weight it has no role."""
        n_updates = 0
        if self.used_weights.instrumental:
            n_updates = self.signals.prior_updates - int(self.policy.n_prior_updates)
        batch_size = self.policy.batch_sizes(self.batch_size)["prior"]
        self.policy.set_learning_rate(self.lr_schedule(1.0))
        if self.verbose and n_updates > 0:
            print(f"prior: {n_updates} updates before the first step (signal_kwargs: prior_updates)", flush=True)
        for _ in range(n_updates):
            rows = expert.draw(batch_size)
            batch = expert.batch(rows, self.actor, self._vec_normalize_env, self.used_weights, self.gamma)
            self.instrumental.update(batch)
            self.policy.n_prior_updates.add_(1)

    # ------------------------------------------------------------------ learn

    def learn(
        self: SelfBase,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "ActPC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfBase:
        """As in SB3, after BC pre-training (:meth:`pretrain`) where there are demonstrations; ValueError where something that
        was set since does not fit."""
        if self.only_acts:
            raise ValueError("a bundled agent comes without its critic and only acts: train a new agent, ActPC(...)")
        try:
            return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        except BaseException:
            self._last_obs = None  # a transition may be lost: the next ``learn`` resets the environments
            raise

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        self._check_settings()
        # Running episodes are cut where SB3 resets the environments, or someone else has stepped in them since
        if self.is_disturbed:
            self._last_obs = None
        if isinstance(self.action_noise, VectorizedActionNoise) and self.action_noise.n_envs != self.n_envs:
            self.action_noise = self.action_noise.base_noise  # of a loaded agent; SB3 makes it one for each environment
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        check_observations(self._last_obs, self.num_timesteps)
        self._update_demonstrations()
        if self.verbose and self._described != self.describe():
            self._described = self.describe()
            print(self._described, flush=True)
        self.pretrain()
        self.start_time = time.time_ns()  # of the frames per second: pre-training has none
        return total_timesteps, callback

    def _cut_running_episodes(self) -> None:
        """The environments are reset in mid-episode."""
        self._rollout_state = None
        self._rollout_starts = np.ones(self.n_envs, dtype=bool)
        self.replay_buffer.cut_running_episodes()
        self.actor_guidance.on_reset()

    def _context(self, episode_starts: np.ndarray | None = None) -> GuidanceContext:
        """What guidance may use of this agent."""
        return GuidanceContext(
            actor=self.actor.circuit,
            targets=[self.policy.actor_target],
            n_envs=self.n_envs,
            episode_starts=np.zeros(self.n_envs, dtype=bool) if episode_starts is None else episode_starts,
            sample=self.sample_imitated if self.imitated_episodes() else None,
            selection_circuits=self.policy.selection_circuits(),
        )

    def imitated_episodes(self) -> list[Episodes]:
        """What refresh draws from: the demonstrations and the self-imitation memory M^actor."""
        parts = [] if self.expert is None else [self.expert.episodes]
        memory = self.replay_buffer.self_imitation
        if memory is not None and memory.episodes is not None:
            parts.append(memory.episodes)
        return parts

    def sample_imitated(self, n: int) -> ImitationBatch:
        """Features (n, n_features), actions (n, A) and working memory of ``n`` imitated steps."""
        samples = sample_union(self.imitated_episodes(), n, self.policy.memory_history, self.actor_guidance.weighting)
        seen, past = (normalized(part, self._vec_normalize_env) for part in (samples.observations, samples.history))
        arrays = seen, samples.actions.astype(np.float32, copy=False), past, samples.history_mask
        observations, actions, history, mask = to_device(arrays, self.device)
        past = self.actor.past_features(history, mask)
        memory = None if past is None or self.actor.memory is None else self.actor.memory(past)
        return self.actor.features(observations), actions, memory

    def _score_stored(self) -> None:
        """Transitions that were stored before a signal had its weight get the signal now, from the present circuits, as the
        demonstrated ones do. They would pay 0 else."""
        weights = self.used_weights
        weighted = bool(weights.epistemic), bool(weights.instrumental)
        is_new = [now and not before for now, before in zip(weighted, self.weighted_signals, strict=True)]
        self.weighted_signals = weighted
        buffer = self.replay_buffer
        if not any(is_new) or not buffer.size():
            return
        if self.optimize_memory_usage:
            raise ValueError(
                f"reward_weights={self.reward_weights!r} were set after transitions were stored with "
                "optimize_memory_usage=True, which does not keep the last observations: give them to the constructor"
            )
        if self.expert is not None:
            self.expert.has_signals = False
        of_new = weights._replace(epistemic=is_new[0] * weights.epistemic, instrumental=is_new[1] * weights.instrumental)
        pairs = np.indices((buffer.size(), buffer.n_envs)).reshape(2, -1)
        for rows, envs in zip(*(np.array_split(part, 1 + len(part) // PART) for part in pairs), strict=True):
            epistemic, instrumental = self.score(buffer.gather(rows, envs, self._vec_normalize_env), of_new)
            if is_new[0]:
                buffer.epistemic[rows, envs] = epistemic
            if is_new[1]:
                buffer.instrumental[rows, envs] = instrumental

    def score_newest(self) -> tuple[np.ndarray, np.ndarray]:
        """Signals of the newest transitions, see :meth:`score`, (n_envs,) each."""
        newest = self.replay_buffer.sample(self.n_envs, self._vec_normalize_env, None, n_newest=self.n_envs)
        return self.score(newest, self.used_weights)

    def score(self, samples: SignalReplaySamples, weights: RewardWeights) -> tuple[np.ndarray, np.ndarray]:
        """Generator and prior settle on transitions: r^ep and r^in as they are stored (lines 10, 12 and 13), (B,) each."""
        raw = self.raw_signals(Batch.of(samples, samples.rewards, self.actor), weights)
        epistemic, instrumental = self.signals.score(*raw, weights)
        check_finite("generator", "signals", epistemic, self.num_timesteps)
        check_finite("prior", "signals", instrumental, self.num_timesteps)
        self.diagnostics.follow(epistemic_signal=epistemic.mean(), instrumental_signal=instrumental.mean())
        return raw if self.signals.normalization == "sampled" else (epistemic, instrumental)

    def raw_signals(self, batch: Batch, weights: RewardWeights) -> tuple[np.ndarray, np.ndarray]:
        """r̂^ep and r̂^in of transitions, (B,) each; zeros where the signal has no weight."""
        epistemic, instrumental = np.zeros((2, len(batch.features)), dtype=np.float32)
        if weights.epistemic:
            epistemic = self.epistemic.score(batch).cpu().numpy()
        if weights.instrumental:
            instrumental = self.instrumental.score(batch).cpu().numpy()
        return epistemic, instrumental

    def sample_batches(self, n_batches: int, batch_size: int) -> Iterator[Batch]:
        """Minibatches of replayed transitions, the newest in each, then the share that comes from the demonstrations."""
        if n_batches > MOST_MINIBATCHES:  # after a whole episode: drawn in parts, for the memory
            for start in range(0, n_batches, MOST_MINIBATCHES):
                yield from self.sample_batches(min(MOST_MINIBATCHES, n_batches - start), batch_size)
            return
        if n_batches < 1:
            return
        expert = self.expert
        actor = self.actor
        env = self._vec_normalize_env
        weights = self.used_weights
        normalizers = self.signals.replayed if weights.has_signals else None
        # Now and then the signals of demonstrated transitions are computed anew, by the present generator
        if expert is not None and self.demonstration_fraction and normalizers is not None:
            last = self._n_updates - 1
            is_due = last // RESCORING_INTERVAL > (last - n_batches) // RESCORING_INTERVAL
            if is_due or not expert.has_signals:
                expert.rescore(lambda batch: self.raw_signals(batch, weights), self.signals.rescored, actor, env)
        # Replayed transitions of all minibatches at once
        sizes = self.policy.batch_sizes(batch_size)
        del sizes["prior"]
        largest = max(sizes.values())
        n_demonstrated = 0 if expert is None else round(self.demonstration_fraction * largest)
        n_newest = self.replay_buffer.n_newest(largest - n_demonstrated)
        n_drawn = n_newest + n_batches * (largest - n_demonstrated - n_newest)
        samples = self.replay_buffer.sample(n_drawn, env, normalizers, n_newest)
        if not weights.epistemic:  # nobody predicts one step
            samples = samples._replace(following_observations=None)
        signals = weights.epistemic * samples.epistemic + weights.instrumental * samples.instrumental
        replayed = Batch.of(samples, weights.task * samples.rewards + signals, actor)
        internal = replayed.rewards - weights.task * samples.rewards
        self.diagnostics.rewards(self._n_updates, n_batches, self.policy_delay, internal, samples.rewards)
        # Demonstrated transitions likewise
        demonstrated = None
        if expert is not None and n_demonstrated:
            rows = expert.draw(n_demonstrated * n_batches)
            demonstrated = expert.batch(rows, actor, env, weights, self.gamma, self.n_steps, normalizers)
        # circuits with a smaller batch take its first rows: the newest, then a fair mixture of the rest
        is_shuffled = min(sizes.values()) < largest
        yield from minibatches(replayed, demonstrated, n_batches, n_newest, is_shuffled)

    # ------------------------------------------------------------------ what is said and logged

    def _log_training(self) -> None:
        values = {**self.diagnostics.values, **self.actor_guidance.logs()}
        memory = self.replay_buffer.self_imitation
        if memory is not None:
            values |= {"self_imitation_size": len(memory), "self_imitation_best_return": memory.best_return}
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for key, value in values.items():
            self.logger.record(f"train/{key}", value)

    def describe(self) -> str:
        """What the reward is made of, and from which demonstrations; ``learn`` prints it with ``verbose=1``, and again when it
        has changed."""
        weights = self.used_weights
        demonstrations = "none" if self.expert is None else repr(self.expert.demonstrations)
        if self.expert is not None and self.expert.failure_reward:
            demonstrations += f", returns counted from {self.expert.failure_reward:g} per step (failure)"
        return (
            f"reward: {weights.task:g} x task + {weights.epistemic:g} x epistemic + {weights.instrumental:g} x instrumental "
            "signal (reward_weights)\n"
            f"demonstrations: {demonstrations}\n{self.actor_guidance.describe()}"
        )

    # ------------------------------------------------------------------ files

    def set_parameters(self, *args: Any, **kwargs: Any) -> None:
        """As in SB3. Returns of the deployed policy say nothing of another one, and a circuit's own learning
        rate is a setting, not a parameter."""
        groups = [group for circuit in self.policy.circuits().values() for group in circuit.optimizer.param_groups]
        scales = [group["lr_scale"] for group in groups]
        super().set_parameters(*args, **kwargs)
        groups = [group for circuit in self.policy.circuits().values() for group in circuit.optimizer.param_groups]
        for group, scale in zip(groups, scales, strict=True):
            group["lr_scale"] = scale
        self._take_residual()
        self.actor_guidance.forget_returns()

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint (:mod:`sb3_actpc.checkpoints`) keeps beside SB3's state: plain values and arrays."""
        expert = self.expert
        return {
            "rollout_state": self._rollout_state,
            "rollout_starts": self._rollout_starts,
            "signals": self.signals.checkpoint_state(),
            "weighted_signals": list(self.weighted_signals),
            "expert_signals": None if expert is None else [expert.epistemic, expert.instrumental, expert.has_signals],
            "diagnostics": dict(self.diagnostics.values),
            "guidance": self.actor_guidance.state_dict(),
        }

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """
        :param state: what :meth:`checkpoint_state` returned
        :raises ValueError: when it was taken with other demonstrations
        """
        if self.expert is None and self.demonstrations is not None:  # ``set_env`` leaves them to what comes next
            self._setup_demonstrations()
        stored = state["expert_signals"]
        n_stored = 0 if stored is None else len(stored[0])
        n_present = 0 if self.expert is None else len(self.expert)
        if n_stored != n_present:
            raise ValueError(
                f"the checkpoint's agent has {n_stored} demonstrated transitions, this one {n_present}: pass the same "
                "demonstrations="
            )
        if self.expert is not None:
            self.expert.epistemic, self.expert.instrumental, self.expert.has_signals = stored
        self._rollout_state = state["rollout_state"]
        self._rollout_starts = state["rollout_starts"]
        self.signals.restore_checkpoint_state(state["signals"])
        self.weighted_signals = tuple(state["weighted_signals"])
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
    def pretrained(cls, env_id: str, env: GymEnv | None = None, **keywords: Any) -> "ActPCBase":
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

        :raises ValueError: for what is no replay buffer, or one of another algorithm, number of environments or shapes; the
            agent keeps its own
        """
        given = self.replay_buffer
        try:
            with named_in_errors(str(path), OSError):
                super().load_replay_buffer(path, truncate_last_traj)
        finally:
            loaded, self.replay_buffer = self.replay_buffer, given
        check_loaded_buffer(path, loaded, isinstance(loaded, SignalReplay), self)
        loaded.history = self.policy.memory_history
        self.replay_buffer = loaded
        self._last_obs = None  # its running episodes are not the agent's: the next ``learn`` resets the environments

    def save_weights(self, path: str | PathLike[str]) -> Path:
        """
        Write weights and settings into a file that cannot run code: see :func:`sb3_actpc.utils.weights.save_weights`.

        :param path: file to write; ``.safetensors`` is added where it is missing
        :return: the file
        :raises ValueError: for a bundled agent, whose critic is not trained, and for settings that cannot be written
        """
        if self.only_acts:
            raise ValueError("a bundled agent comes without its critic and only acts: it is in the package already")
        return save_weights(self, path)

    @classmethod
    def from_weights(cls: type[SelfBase], path: str | PathLike[str], env: GymEnv | str, **keywords: Any) -> SelfBase:
        """
        An agent from a file of :meth:`save_weights`: see :func:`sb3_actpc.utils.weights.load_weights`.

        :param path: the file
        :param env: the environment, or its id
        :param keywords: constructor keywords that replace the stored ones; ``demonstrations`` are not in the file
        """
        without = () if keywords.get("demonstrations") is not None else (*NEED_DEMONSTRATIONS, "observation_normalization")
        return load_weights(cls, path, env, without=without, **keywords)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *_OF_POLICY, *_DERIVED]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names = [name if name != "actor" else "actor.circuit" for name in self.policy.circuits()]
        learned = [name for name in ("epistemic", "instrumental") if isinstance(getattr(self, name), th.nn.Module)]
        return ["policy", *(f"policy.{name}.optimizer" for name in names), *learned], []
