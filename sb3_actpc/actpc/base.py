"""What stands between SB3 and Algorithm 1: the agent's parts, demonstrations, batches and what is said of them."""

import sys
import time
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.actpc.buffers import SignalReplay, combined_buffer_class
from sb3_actpc.actpc.demonstration_replay import DemonstrationReplay
from sb3_actpc.actpc.diagnostics import Diagnostics
from sb3_actpc.actpc.features import Batch, CircuitInputs, minibatches
from sb3_actpc.actpc.persistence import NEED_DEMONSTRATIONS, Persistent
from sb3_actpc.actpc.policies import ActPCActor, ActPCPolicy
from sb3_actpc.actpc.reward_signals import InternalSignals
from sb3_actpc.actpc.self_imitation import Episodes, sample_union
from sb3_actpc.actpc.transfer import to_device
from sb3_actpc.actpc.validation import (
    check_agreement,
    check_buffer_kwargs,
    check_goal_env,
    check_observations,
    check_own_learning_rates,
    check_policy_kwargs,
    finite_bounds,
    warn_of_idle_settings,
)
from sb3_actpc.demonstrations.mixin import LearnsFromDemonstrations
from sb3_actpc.guidance import ActorGuidance, BehaviorGuidance, GuidanceConfig, GuidanceContext
from sb3_actpc.guidance.base import ImitationBatch
from sb3_actpc.utils.arguments import Between
from sb3_actpc.utils.checks import Settings, check_finite, check_kind, named_in_errors, nearest
from sb3_actpc.utils.extras import import_extra

SelfBase = TypeVar("SelfBase", bound="ActPCBase")
RESCORING_INTERVAL = 1000  # updates between two evaluations of the demonstrations' signals


class ActPCBase(LearnsFromDemonstrations, Persistent):
    """
    What stands between SB3 and Algorithm 1: the agent's parts, its demonstrations, and the batches that it learns from.

    The attributes are :class:`~sb3_actpc.actpc.actpc.ActPC`'s, whose constructor documents them.
    """

    action_space: spaces.Box
    policy: ActPCPolicy
    actor: ActPCActor
    replay_buffer: SignalReplay
    settling: str
    guidance: ActorGuidance | str
    guidance_kwargs: Settings | None
    signal_kwargs: Settings | None
    alpha_ext: float
    alpha_ep: float
    alpha_in: float
    bootstrap: str
    critic_weight: float
    refresh_weight: float
    policy_delay: int
    demonstration_fraction: float
    observation_normalization: str
    prior_updates: int
    _used_demonstrations: tuple[Any, ...]
    _described: str
    _is_stepping: bool
    only_acts: bool

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
    def inputs(self) -> CircuitInputs:
        """Turns observations into what the circuits see."""
        return CircuitInputs(self.actor, self._vec_normalize_env)

    @property
    def reward_weights(self) -> tuple[float, float, float]:
        """(α_ext, α_ep, α_in) as used: without demonstrations there is no prior."""
        return self.alpha_ext, self.alpha_ep, 0.0 if self.demonstrations is None else self.alpha_in

    # ------------------------------------------------------------------ parts

    def _setup_model(self) -> None:
        if self.action_space is None:
            raise ValueError("env=None: an environment or the id of one is needed, such as 'Pendulum-v1'")
        self._check_actions()
        self._check_agreement()
        self.actor_guidance = make_guidance(self.guidance, self.guidance_kwargs)
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self._make_policy().to(self.device)
        self.actor = self.policy.actor
        self.critic = self.policy.critic
        self.generator = self.policy.generator
        self.prior = self.policy.prior
        self.actor_target = self.policy.actor_target
        self.critic_target = self.policy.critic_target
        self.diagnostics = Diagnostics(self.policy)
        self._setup_signals()
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        self._convert_train_freq()
        self._setup_demonstrations()

    def _check_agreement(self) -> None:
        every = self.train_freq
        check_agreement(self.alpha_ep, self.optimize_memory_usage, self.bootstrap, self.n_steps, self.n_envs, every)

    def _make_policy(self) -> ActPCPolicy:
        kwargs = check_policy_kwargs(self.policy_class, self.policy_kwargs, self.settling, self.actor_guidance.has_gate)
        policy = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **kwargs)
        assert isinstance(policy, ActPCPolicy)
        return policy

    def _setup_signals(self) -> None:
        """A loaded agent may be given other signals; of the same ones it keeps what their normalizers have seen."""
        with named_in_errors(f"signal_kwargs={self.signal_kwargs!r}"):
            signals = InternalSignals(**(self.signal_kwargs or {}))
        if signals.settings != self.signals.settings:
            self.signals = signals
        self.epistemic = signals.epistemic_class(self.policy.generator, self.diagnostics, signals.errors)
        self.instrumental = signals.instrumental_class(self.policy.prior, self.diagnostics, signals.errors)

    def _make_replay_buffer(self) -> SignalReplay:
        kind = combined_buffer_class(self.replay_buffer_class, self.observation_space, self.n_steps)
        kwargs: dict[str, Any] = {"history": self.policy.memory_history, "n_steps": self.n_steps, "gamma": self.gamma}
        check_buffer_kwargs(kind, self.replay_buffer_kwargs, kwargs)
        if issubclass(kind, HerReplayBuffer):
            assert self.env is not None, "You must pass an environment when using `HerReplayBuffer`"  # as SB3 does
            check_goal_env(kind, self.env, self.observation_space)
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
        """As in SB3. Returns of another environment are dropped; ValueError where demonstrations do not fit."""
        super().set_env(env, force_reset)
        self.actor_guidance.forget_returns()
        if self.replay_buffer is not None:
            self.replay_buffer.forget_own_episodes()
        if isinstance(self.replay_buffer, HerReplayBuffer):
            assert self.env is not None
            self.replay_buffer.env = self.env  # whose rewards relabelled transitions get
        self._setup_demonstrations()

    # ------------------------------------------------------------------ demonstrations

    def _setup_demonstrations(self) -> None:
        """
        Fit the demonstrations to the environment, and the observation normalizer to them or to the bounds.

        :raises ValueError: for demonstrations that do not fit, for settings that need some
        """
        self.expert = None
        self._used_demonstrations = self.demonstrations, self.n_demonstrations, self.n_demonstration_transitions
        is_trained = self.is_pretrained or self.num_timesteps > 0
        if self.demonstrations is None:
            self._drop_demonstrations(is_trained)
        elif self.env is not None or not isinstance(self.observation_space, spaces.Dict):  # a goal task: in ``set_env``
            try:
                demonstrations = self._fitted_demonstrations()
                self.expert = DemonstrationReplay(
                    demonstrations, self.observation_space, self.action_space, self.policy.memory_history
                )
            except (FileNotFoundError, ImportError, ValueError) as error:
                if not is_trained:
                    raise
                # a trained agent acts without them; ``learn`` says what is missing
                if self.env is not None and not isinstance(error, FileNotFoundError):
                    kind = ImportError if isinstance(error, ImportError) else ValueError
                    raise kind(f"{error}. A trained agent can do without: demonstrations=None") from error
        self._fit_normalizer()

    def _drop_demonstrations(self, is_trained: bool) -> None:
        """A trained agent keeps what it has learned from demonstrations; another one needs them for its settings."""
        needing = [name for name in NEED_DEMONSTRATIONS if getattr(self, name)]
        if self.observation_normalization == "demonstrations":
            needing.append("observation_normalization")
        if needing and not is_trained:
            raise ValueError(f"{' and '.join(needing)} need demonstrations=; pass a file or leave them out")
        self.demonstration_fraction = 0.0
        self.n_demonstrations = None
        self.n_demonstration_transitions = None

    def _fit_normalizer(self) -> None:
        """An actor that has imitated keeps the statistics of its demonstrations."""
        normalizer = self.actor.normalizer
        inputs = self.inputs
        if self.observation_normalization == "bounds":
            bounds = finite_bounds(self.observation_space, inputs.are_normalised)
            normalizer.begin()
            normalizer.fit(inputs.features(inputs.observations(bounds)))
        elif self.observation_normalization == "demonstrations" and self.expert is not None and not self.is_pretrained:
            normalizer.begin()
            if not inputs.are_normalised:
                normalizer.fit(self.expert.features(inputs))

    def _update_demonstrations(self) -> None:
        """
        Use demonstrations that were set since. A prior and a normalizer that have learned stay as they are.

        :raises ValueError: when they do not fit, or are not there
        """
        if isinstance(self.demonstrations, Path):  # which one system could not unpickle from another
            self.demonstrations = str(self.demonstrations)
        if self.demonstrations is not None and self._used_demonstrations[0] is None and self.guidance == "none":
            warnings.warn(
                "demonstrations were set after the agent was made without: guidance='none' "
                f"(no BC pre-training), n_steps={self.n_steps} and demonstration_fraction={self.demonstration_fraction:g} "
                "stay. For the defaults with demonstrations, pass demonstrations= to the constructor",
                stacklevel=5,
            )
        now = self.demonstrations, self.n_demonstrations, self.n_demonstration_transitions
        if self.expert is None or any(mine is not used for mine, used in zip(now, self._used_demonstrations, strict=True)):
            self._setup_demonstrations()
        if self.expert is None and self.demonstrations is not None:
            raise ValueError(
                f"no demonstrations file at {self.demonstrations}, and learning needs it: put it back, or set "
                "agent.demonstrations"
            )
        # one discount and one length of returns for what is replayed and what is demonstrated, of a loaded buffer too
        self.replay_buffer.set_returns(self.n_steps, self.gamma)
        memory = self.replay_buffer.self_imitation
        if memory is not None:
            memory.takes_all = self.actor_guidance.stores == "positive" and self.expert is not None
        imitates = self.is_pretrained and self.refresh_weight > 0
        warn_of_idle_settings(self.demonstrations is not None, imitates, (self.alpha_ext, self.alpha_ep, self.alpha_in))

    def pretrain(self, progress_bar: bool = False) -> None:
        """
        Train the prior on the demonstrations and let guidance start, once; ``learn`` calls this.

        :param progress_bar: show one
        """
        expert = self.expert
        if expert is not None:
            if not self.is_pretrained:
                self._fit_normalizer()
                self._show_to_vec_normalize(expert)
            # without a weight the prior has no role
            n_updates = self.prior_updates - int(self.policy.n_prior_updates) if self.alpha_in else 0
            batch_size = self.policy.batch_sizes(self.batch_size)["prior"]
            self.policy.set_learning_rate(self.lr_schedule(1.0))
            seconds = 0.1 if sys.stderr.isatty() else 5.0  # between two drawings: a file or a notebook keeps them all
            updates: Iterable[int] = range(n_updates)
            if progress_bar and n_updates > 0:
                updates = import_extra("tqdm", "experiments").tqdm(updates, "prior", mininterval=seconds)
            for _ in updates:
                batch = expert.sample(batch_size, self.inputs, self.reward_weights, self.gamma)
                self.instrumental.update(batch.features, batch.actions, batch.next_features, batch.memory)
                self.policy.n_prior_updates.add_(1)
        # BC is of demonstrations: an agent without does not imitate its own episodes first
        self.actor_guidance.on_training_start(self._context(), self.is_pretrained or expert is None)
        if expert is not None:
            self.policy.has_imitated.fill_(1.0)

    def _show_to_vec_normalize(self, expert: DemonstrationReplay) -> None:
        """VecNormalize's statistics take in the demonstrations: they have seen one observation else."""
        normalize = self._vec_normalize_env
        if normalize is None or not normalize.norm_obs:
            return
        warnings.warn(
            "VecNormalize's observation statistics drift under what is learned now, and those of the demonstrations "
            "(observation_normalization) are not used: use VecNormalize(norm_obs=False)",
            stacklevel=3,
        )
        if normalize.training:
            expert.show_to(normalize)
            if self._last_original_obs is not None:
                self._last_obs = normalize.normalize_obs(self._last_original_obs)

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
        """As in SB3, after BC pre-training (:meth:`pretrain`) where there are demonstrations; ValueError for a bad number of
        environment steps, and where something that was set since does not fit."""
        if self.only_acts:
            raise ValueError("a bundled agent comes without its critic and only acts: train a new agent, ActPC(...)")
        check_kind("total_timesteps", total_timesteps, float)
        Between(0)("total_timesteps", total_timesteps)
        try:
            super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        except BaseException:
            if self._is_stepping:  # a transition was lost: the next ``learn`` resets the environments
                self._last_obs = None
            raise
        return self

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        self._check_agreement()
        check_own_learning_rates(self.policy.kwargs_of, self.lr_schedule(1.0))
        self._continue_episodes(reset_num_timesteps)
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        check_observations(self._last_obs, self.num_timesteps)
        self._update_demonstrations()
        if self.verbose and self._described != self.describe():
            self._described = self.describe()
            print(self._described, flush=True)
        self.pretrain(has_progress_bar(callback))
        self.start_time = time.time_ns()  # of the frames per second: pre-training has none
        return total_timesteps, callback

    def _cut_running_episodes(self) -> None:
        """The environments are reset in mid-episode."""
        self._rollout_state = None
        self._rollout_starts = np.ones(self.n_envs, dtype=bool)
        self.replay_buffer.cut_running_episodes()
        self.actor_guidance.on_reset()

    def _continue_episodes(self, reset_num_timesteps: bool) -> None:
        """Running episodes are cut where SB3 resets the environments, or someone else has stepped in them since."""
        if self.is_disturbed:
            self._last_obs = None
        if isinstance(self.action_noise, VectorizedActionNoise) and self.action_noise.n_envs != self.n_envs:
            self.action_noise = self.action_noise.base_noise  # of a loaded agent; SB3 makes it one for each environment
        if reset_num_timesteps or self._last_obs is None:
            self._cut_running_episodes()

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
        parts: list[Episodes] = []
        if self.expert is not None:
            parts.append(self.expert.episodes)
        memory = self.replay_buffer.self_imitation
        if memory is not None and memory.episodes is not None:
            parts.append(memory.episodes)
        return parts

    def sample_imitated(self, n: int) -> ImitationBatch:
        """Features (n, n_features), actions (n, A) and working memory of ``n`` imitated steps."""
        inputs = self.inputs
        samples = sample_union(self.imitated_episodes(), n, self.policy.memory_history, self.actor_guidance.weighting)
        arrays = inputs.normalized(samples.observations), samples.actions.astype(np.float32, copy=False)
        observations, actions = to_device(arrays, inputs.device)
        memory = inputs.memory(*inputs.past(samples.history, samples.history_mask))
        return inputs.features(observations), actions, memory

    def score_newest(self) -> tuple[np.ndarray, np.ndarray]:
        """Generator and prior settle on the newest transitions: r^ep and r^in as they are stored (lines 10, 12 and 13),
        (n_envs,) each."""
        newest = self.replay_buffer.newest_transitions()
        inputs = self.inputs
        features = inputs.features(inputs.observations(newest.observations))
        next_features = inputs.features(inputs.observations(newest.next_observations))
        memory = inputs.memory(*inputs.past(newest.history, newest.history_mask))
        raw = self.raw_signals(features, inputs.tensor(newest.actions), next_features, memory)
        epistemic, instrumental = self.signals.score(*raw, *self.reward_weights[1:])
        check_finite("generator", "signals", epistemic, self.num_timesteps)
        check_finite("prior", "signals", instrumental, self.num_timesteps)
        self.diagnostics.follow(epistemic_signal=epistemic.mean(), instrumental_signal=instrumental.mean())
        return raw if self.signals.normalization == "sampled" else (epistemic, instrumental)

    def raw_signals(
        self, features: th.Tensor, actions: th.Tensor, next_features: th.Tensor, memory: th.Tensor | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """r̂^ep and r̂^in of transitions, (B,) each; zeros where the signal has no weight."""
        _, alpha_ep, alpha_in = self.reward_weights
        epistemic, instrumental = np.zeros((2, len(features)), dtype=np.float32)
        if alpha_ep:
            epistemic = self.epistemic.score(features, actions, next_features, memory).cpu().numpy()
        if alpha_in:
            instrumental = self.instrumental.score(features, actions, next_features, memory).cpu().numpy()
        return epistemic, instrumental

    def sample_batches(self, n_batches: int, batch_size: int) -> Iterator[Batch]:
        """Minibatches of replayed transitions, the newest in each, then the share that comes from the demonstrations."""
        if n_batches < 1:
            return iter(())
        expert, inputs, weights = self.expert, self.inputs, self.reward_weights
        # Now and then the signals of demonstrated transitions are computed anew, by the present generator
        has_signals = any(weights[1:])
        if expert is not None and self.demonstration_fraction and has_signals:
            if self._n_updates % RESCORING_INTERVAL == 1 or not expert.has_signals:
                expert.rescore(self.raw_signals, inputs, self.signals.rescored)
        # Replayed transitions of all minibatches at once
        sizes = self.policy.batch_sizes(batch_size)
        del sizes["prior"]
        largest = max(sizes.values())
        n_demonstrated = 0 if expert is None else round(self.demonstration_fraction * largest)
        n_newest = self.replay_buffer.n_newest(largest - n_demonstrated)
        n_drawn = n_newest + n_batches * (largest - n_demonstrated - n_newest)
        normalizers = self.signals.replayed if has_signals else None
        samples = self.replay_buffer.sample(n_drawn, self._vec_normalize_env, normalizers, n_newest)
        replayed = inputs.replayed(samples, weights, self.gamma)
        self.diagnostics.rewards(self._n_updates, n_batches, self.policy_delay, replayed.rewards, samples.rewards, weights[0])
        # Demonstrated transitions likewise
        demonstrated = None
        if expert is not None and n_demonstrated:
            demonstrated = expert.sample(n_demonstrated * n_batches, inputs, weights, self.gamma, self.n_steps, normalizers)
        # circuits with a smaller batch take its first rows: the newest, then a fair mixture of the rest
        is_shuffled = min(sizes.values()) < largest
        return minibatches(replayed, demonstrated, n_batches, n_newest, is_shuffled)

    # ------------------------------------------------------------------ what is said and logged

    def _log_training(self) -> None:
        values = {**self.diagnostics.summary(), **self.actor_guidance.logs()}
        memory = self.replay_buffer.self_imitation
        if memory is not None:
            values |= {"self_imitation_size": len(memory), "self_imitation_best_return": memory.best_return}
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for key, value in values.items():
            self.logger.record(f"train/{key}", value)

    def describe(self) -> str:
        """What the reward is made of, from which demonstrations, and what is off; ``learn`` prints it with ``verbose=1``, and
        again when it has changed."""
        ext, ep, inst = self.reward_weights
        parts = {
            "the task's reward": ext,
            "generator": ep,
            "prior": inst,
            "critic term": self.critic_weight,
            "refresh": self.refresh_weight,
            "self-imitation": self.replay_buffer.self_imitation is not None,
            "demonstrations in the critic's batch": self.demonstration_fraction,
            "working memory": self.policy.memory_history,
        }
        off = ", ".join(name for name, value in parts.items() if not value) or "nothing"
        demonstrations = "none" if self.expert is None else repr(self.expert.demonstrations)
        return (
            f"reward: {ext:g} x task (alpha_ext) + {ep:g} x epistemic (alpha_ep) + {inst:g} x instrumental signal (alpha_in)\n"
            f"demonstrations: {demonstrations}\n{self.actor_guidance.describe()}\noff: {off}"
        )


def make_guidance(given: ActorGuidance | str, settings: Settings | None) -> ActorGuidance:
    """:raises ValueError: for another name, or keywords that the guidance has not"""
    if isinstance(given, ActorGuidance):
        if settings:
            raise ValueError(f"guidance_kwargs={settings!r} are for guidance='default': set up the ActorGuidance itself")
        return given
    if given not in ("default", "none"):
        raise ValueError(f"guidance={given!r} must be None, 'default', 'none' or an ActorGuidance")
    known = GuidanceConfig.names()
    for name in settings or {}:
        if name not in known:
            raise ValueError(f"guidance_kwargs has {name!r}{nearest(name, known)}; choose from {known}")
    config = GuidanceConfig(**(settings or {}))
    if given == "default":
        return BehaviorGuidance(config)
    if settings:
        warnings.warn(
            f"guidance_kwargs={settings!r} have no effect without guidance, which is on with demonstrations= or "
            "guidance='default'",
            stacklevel=4,
        )
    return ActorGuidance()


def has_progress_bar(callback: BaseCallback) -> bool:
    """Whether a progress bar is among them, asked for by ``progress_bar`` or given."""
    return isinstance(callback, ProgressBarCallback) or any(map(has_progress_bar, getattr(callback, "callbacks", ())))
