"""ActPC: active predictive coding as a Stable-Baselines3 algorithm (Ororbia & Mali, arXiv 2209.09174, Algorithm 1)."""

import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim, get_obs_shape
from stable_baselines3.common.type_aliases import (
    GymEnv,
    MaybeCallback,
    RolloutReturn,
    Schedule,
    TrainFrequencyUnit,
)
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from tqdm import tqdm

from sb3_actpc.actpc.buffers import CombinedHerReplayBuffer, SignalReplay, combined_buffer_class, relabels
from sb3_actpc.actpc.demonstration_replay import DemonstrationReplay
from sb3_actpc.actpc.diagnostics import Diagnostics
from sb3_actpc.actpc.features import Batch, CircuitInputs
from sb3_actpc.actpc.policies import POLICIES, ActPCActor, ActPCPolicy, check_policy, check_policy_kwargs
from sb3_actpc.actpc.reward_signals import InternalSignals, summed_squared_errors
from sb3_actpc.actpc.self_imitation import Episodes, Observations, sample_union
from sb3_actpc.actpc.transfer import to_device
from sb3_actpc.checkpoints import Restored, load_checkpoint
from sb3_actpc.demonstrations import fit_demonstrations
from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.recording import ENDLESS
from sb3_actpc.guidance import ActorGuidance, BehaviorGuidance, GuidanceConfig, GuidanceContext
from sb3_actpc.guidance.base import ImitationBatch
from sb3_actpc.ngc import NGCCircuit, settle_coupled
from sb3_actpc.utils.arguments import (
    MAX_SEED,
    Between,
    Count,
    Share,
    Size,
    Weight,
    check_actions,
    check_computes,
    check_env,
    check_learning_rate,
    check_noise,
    check_train_freq,
    checked,
)
from sb3_actpc.utils.callbacks import between_updates
from sb3_actpc.utils.checks import Settings, check_finite, check_kind, named_in_errors, nearest
from sb3_actpc.utils.constructors import constructor_keywords
from sb3_actpc.utils.nested import map_observations
from sb3_actpc.utils.rollouts import StoresLastTransition
from sb3_actpc.utils.weights import load_weights, save_weights

SelfActPC = TypeVar("SelfActPC", bound="ActPC")
# of the mean absolute action-value that divides the critic term: before any reward was seen, the critic's noise must not
# be scaled up to full strength
SMALLEST_VALUE_SCALE = 1.0
_OF_ANOTHER_VERSION = "{path} is of another version of sb3_actpc ({why}): load it with that one"
NEED_DEMONSTRATIONS = ("demonstration_fraction", "n_demonstrations", "n_demonstration_transitions")
EXPERT_SIGNALS_INTERVAL = 1000  # updates between two evaluations of the demonstrations' signals
PRETRAINING_INTERVAL = 5000  # updates between two lines about pre-training
TARGET_NOISE_CLIP = 2.5  # standard deviations, as TD3's 0.5 for 0.2
LARGEST_BOUND = 1e6  # of an observation; larger ones stand for none


class ActPC(StoresLastTransition):
    """
    Active predictive coding: four NGC circuits that learn by settling and Hebbian changes, never by backprop.

    The actor acts; the critic values its actions; the generator's surprise is an epistemic reward; the prior, learned from
    demonstrations and then frozen, gives an instrumental one. Paper: https://arxiv.org/abs/2209.09174.

    Defaults are one setting for all demonstrations (README has its results); the paper's own values are in
    ``hyperparams/actpc_paper.yml``. Keywords whose default is None have one value with demonstrations and one without:

    ====================================== ============== =======
    keyword                                demonstrations without
    ====================================== ============== =======
    ``learning_starts``                    0              100
    ``n_steps``                            3              1
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
    :param tau: how far the target circuits move towards the circuits, of the whole way
    :param gamma: discount
    :param train_freq: environment steps (or episodes) between updates
    :param gradient_steps: updates each time; -1 for as many as steps were collected
    :param action_noise: SB3's exploration noise, in the place of ``exploration_noise``
    :param replay_buffer_class: None, or one of SB3's classes or its name (its ActPC counterpart is used)
    :param replay_buffer_kwargs: keywords of the buffer: ``combined`` (True: the newest transition of every environment is in
        every batch, half of which these are at most) and ``self_imitation_size`` (transitions in the memory of the agent's
        own good episodes: 100,000, or ``buffer_size`` where that is less; 0 for none), with hindsight ``random_goals``
        (0.375: share of the relabelled transitions whose goal was reached in any episode), and those of SB3's class
    :param optimize_memory_usage: as in SB3; not with a generator (``alpha_ep``), which learns where every step led
    :param n_steps: length of n-step returns; 1 by default where they cannot be had (hindsight, ``optimize_memory_usage``)
        or mean nothing (``bootstrap="literal"``)
    :param settling: "scheduled" (one ordered sweep of the errors, the zero-divergence schedule or Z-IL of the
        predictive-coding literature) or "iterative" (settle, then change; the paper's K steps
        of eq. 1 with ``circuit_kwargs=dict(dynamics="state")``)
    :param exploration_noise: standard deviation of the Gaussian noise on the actions in [-1, 1]; with guidance at most the
        residual standard deviation of the demonstrated actions. 0 for none (the paper)
    :param policy_delay: updates of the critic for each of the actor; the paper's is 1
    :param demonstrations: a path, a Minari id, or a :class:`~sb3_actpc.demonstrations.dataset.Demonstrations`. A path is saved
        as it was given; others can be set later (``agent.demonstrations = ...``), which a trained prior outlasts
    :param n_demonstrations: use only the first so many episodes of them
    :param n_demonstration_transitions: use only the first so many transitions (the paper's "300 samples")
    :param prior_updates: updates of the prior on the demonstrations before learning starts, where ``alpha_in`` gives it a
        role; then it is frozen
    :param refresh_weight: weight of the actor's refresh from the demonstrations and its own good episodes
    :param demonstration_fraction: share of the batch, which all circuits share, that comes from the demonstrations
    :param alpha_ep: weight of the epistemic signal
    :param alpha_in: weight of the instrumental signal
    :param alpha_ext: weight of the task's reward (the paper's is 0 with demonstrations)
    :param signal_kwargs: keywords of :class:`~sb3_actpc.actpc.reward_signals.InternalSignals`: ``normalizer``,
        ``normalization`` (which by default keep the signals alive), ``instrumental_form``, ``errors``
    :param critic_weight: weight of the critic term in the actor's update. 0 leaves imitation alone
    :param normalize_critic_term: divide that term by the batch's mean absolute action-value (at least 1)
    :param bootstrap: "joint" (target critic at the target actor's next action, the appendix) or "literal" (at the action
        taken, the main text's equation)
    :param target_policy_noise: standard deviation of the noise on the target actor's action; 0 for none
    :param target_update_interval: the targets move after every update (1), or every so many environment steps; hard copies
        as in DQN are ``tau=1, target_update_interval=C``
    :param observation_normalization: "none" (the paper), "demonstrations" (their mean and standard deviation, fixed)
        or "bounds" (those of the observation space, which must be finite, become -1 and 1)
    :param guidance: what is added to the paper (:mod:`sb3_actpc.guidance`): None for the default guidance with demonstrations
        and none without, "default", "none" for the paper's agent, or an
        :class:`~sb3_actpc.guidance.base.ActorGuidance`
    :param guidance_kwargs: keywords of :class:`~sb3_actpc.guidance.guidance.GuidanceConfig`
    :param policy_kwargs: keywords of :class:`~sb3_actpc.actpc.policies.ActPCPolicy`: ``net_arch``, ``n_critics``, ``nudge``,
        ``memory_history`` (the working memory), ``circuit_kwargs`` (of every :class:`~sb3_actpc.ngc.NGCCircuit`:
        ``n_settling_steps``, ``feedback``, ``dynamics``, ``normalization``,
        ``synaptic_scaling``, ...), ``actor_kwargs``, ``critic_kwargs``, ``generator_kwargs`` and ``prior_kwargs`` (of one, and
        its ``net_arch``, ``learning_rate`` and ``batch_size``)
    :param stats_window_size: as in SB3
    :param tensorboard_log: as in SB3
    :param verbose: as in SB3; from 1 on, ``learn`` also says what the reward is made of
    :param device: as in SB3
    :param seed: as in SB3
    :raises ValueError: for a keyword with a value that is not allowed, for action spaces that are not Boxes, for
        demonstrations that do not fit the environment
    :raises FileNotFoundError: where no demonstrations file is
    :raises ImportError: for a Minari id without the extra ``minari``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = POLICIES
    policy: ActPCPolicy
    replay_buffer: SignalReplay | None
    actor: ActPCActor
    critic: NGCCircuit
    critic_target: NGCCircuit
    generator: NGCCircuit
    prior: NGCCircuit
    actor_target: NGCCircuit

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
        action_noise: Annotated[ActionNoise | None, check_noise] = None,
        replay_buffer_class: type[ReplayBuffer] | str | None = None,
        replay_buffer_kwargs: Settings | None = None,
        optimize_memory_usage: bool = False,
        n_steps: Annotated[int | None, Between(1)] = None,
        *,
        settling: Literal["iterative", "scheduled"] = "scheduled",
        demonstrations: Demonstrations | str | Path | None = None,
        n_demonstrations: Annotated[int | None, Between(1)] = None,
        n_demonstration_transitions: Annotated[int | None, Between(1)] = None,
        prior_updates: Count = 2000,
        refresh_weight: Weight = 1.0,
        demonstration_fraction: Annotated[float | None, Between(0, 1)] = None,
        exploration_noise: Weight = 0.1,
        alpha_ep: Weight = 0.0,
        alpha_in: Weight = 0.0,
        alpha_ext: float = 1.0,
        signal_kwargs: Settings | None = None,
        critic_weight: Weight = 1.0,
        normalize_critic_term: bool = True,
        policy_delay: Size = 4,
        bootstrap: Literal["joint", "literal"] = "joint",
        target_policy_noise: Weight = 0.2,
        target_update_interval: Annotated[int, Between(1)] = 1,
        observation_normalization: Literal["none", "demonstrations", "bounds"] | None = None,
        guidance: ActorGuidance | str | None = None,
        guidance_kwargs: Settings | None = None,
        policy_kwargs: Settings | None = None,
        stats_window_size: Size = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        device: Annotated[th.device | str, check_computes] = "auto",
        seed: Annotated[int | None, Between(0, MAX_SEED)] = None,
        _init_setup_model: bool = True,
    ) -> None:
        has_demonstrations = demonstrations is not None

        def default(given: Any, with_demonstrations: Any, without: Any) -> Any:
            if given is not None:
                return given
            return with_demonstrations if has_demonstrations else without

        is_one_step = relabels(replay_buffer_class) or optimize_memory_usage or bootstrap == "literal"
        n_steps = default(n_steps, 1 if is_one_step else 3, 1)
        if guidance is None:
            guidance = "default" if has_demonstrations else "none"
        self.guidance = guidance
        self.guidance_kwargs = guidance_kwargs
        self.actor_guidance = _make_guidance(guidance, guidance_kwargs)
        if self.actor_guidance.has_gate:
            policy_kwargs = {"is_gated": True, **(policy_kwargs or {})}
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            default(learning_starts, 0, 100),
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,  # type: ignore[arg-type]
            replay_buffer_kwargs=dict(replay_buffer_kwargs or {}),
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=dict(policy_kwargs or {}),
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
        self.demonstrations = str(demonstrations) if isinstance(demonstrations, Path) else demonstrations
        self.n_demonstrations = n_demonstrations
        self.n_demonstration_transitions = n_demonstration_transitions
        self.prior_updates = prior_updates
        self.refresh_weight = refresh_weight
        self.demonstration_fraction: float = default(demonstration_fraction, 0.5, 0.0)
        self.exploration_noise = exploration_noise
        self.alpha_ep = alpha_ep
        self.alpha_in = alpha_in
        self.alpha_ext = alpha_ext
        self.critic_weight = critic_weight
        self.normalize_critic_term = normalize_critic_term
        self.policy_delay = policy_delay
        self.bootstrap = bootstrap
        self.target_policy_noise = target_policy_noise
        self.target_update_interval = target_update_interval
        self.observation_normalization: str = default(observation_normalization, "demonstrations", "none")
        self.signal_kwargs = signal_kwargs
        self.signals = InternalSignals()
        self._is_stepping = False  # between a choice of actions and the storage of what followed
        self._awaits_parameters = not _init_setup_model  # ``load`` sets them
        self._steps_at_pause: list[int] | None = None  # that the environments had made when ``learn`` ended
        if _init_setup_model:
            self._setup_model()
            self._check_learning_rates()

    # ------------------------------------------------------------------ setting up

    def _setup_model(self) -> None:
        if self.action_space is None:
            raise ValueError("env=None: an environment or the id of one is needed, such as 'Pendulum-v1'")
        assert isinstance(self.action_space, spaces.Box)
        check_actions(self.action_space, self.action_noise)
        self._check_together()
        self.actor_guidance = _make_guidance(self.guidance, self.guidance_kwargs)
        # here, as a loaded agent may be given others; of the same signals it keeps what their normalizers have seen
        with named_in_errors(f"signal_kwargs={self.signal_kwargs!r}"):
            signals = InternalSignals(**(self.signal_kwargs or {}))
            self.signals = self.signals if self.signals.settings == signals.settings else signals
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self._make_policy().to(self.device)
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        self._convert_train_freq()
        self._create_aliases()
        self._setup_demonstrations()
        self._fit_to_bounds()
        self.diagnostics = Diagnostics(self.policy)

    def _make_policy(self) -> ActPCPolicy:
        given = self.policy_kwargs.get("circuit_kwargs") or {}
        check_kind("circuit_kwargs", given, Settings | None)
        chosen = given.get("settling", self.settling)
        if not isinstance(chosen, str) or chosen != self.settling:
            raise ValueError(f"circuit_kwargs has settling={chosen!r} but the agent's is {self.settling!r}; pass settling=")
        kwargs = {**self.policy_kwargs, "circuit_kwargs": {**given, "settling": self.settling}}
        check_policy_kwargs(self.policy_class, kwargs)
        policy = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **kwargs)
        assert isinstance(policy, ActPCPolicy)
        return policy

    def _check_learning_rates(self) -> None:
        """:raises ValueError: where a circuit's own rate would be a multiple of 0; a loaded agent that only acts may be so"""
        for name, settings in self.policy.kwargs_of.items():
            own = (settings or {}).get("learning_rate")
            if own and not self.lr_schedule(1.0):
                raise ValueError(
                    f"{name}_kwargs has learning_rate={own}, a multiple of the agent's, which begins at 0: begin above"
                )

    def _make_replay_buffer(self) -> SignalReplay:
        kind = combined_buffer_class(self.replay_buffer_class, self.observation_space, self.n_steps)
        kwargs: dict[str, Any] = {"history": self.memory_history, "n_steps": self.n_steps, "gamma": self.gamma}
        for name in kwargs.keys() & self.replay_buffer_kwargs:
            raise ValueError(
                f"replay_buffer_kwargs has {name!r}: give it to the agent (history: policy_kwargs['memory_history'])"
            )
        kwargs |= self.replay_buffer_kwargs
        known = constructor_keywords(kind)
        for name in kwargs.keys() - known:
            raise ValueError(f"replay_buffer_kwargs has {name!r}, which {kind.__name__} does not take{nearest(name, known)}")
        if issubclass(kind, HerReplayBuffer):
            assert self.env is not None, "You must pass an environment when using `HerReplayBuffer`"  # as SB3 does
            assert isinstance(self.observation_space, spaces.Dict)
            if not {"achieved_goal", "desired_goal"} <= set(self.observation_space) or not self.env.has_attr("compute_reward"):
                raise ValueError(
                    f"replay_buffer_class={kind.__name__} relabels goals: the environment needs 'achieved_goal' and "
                    "'desired_goal' in its observations, and compute_reward, as gymnasium_robotics.GoalEnv has them"
                )
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
            )

    @property
    def memory_history(self) -> int:
        """H, observations in the working memory; 0 without one."""
        return self.policy.memory_history

    @property
    def n_critics(self) -> int:
        """Critic circuits."""
        return self.policy.n_critics

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
        self._followed = self.demonstrations, self.n_demonstrations, self.n_demonstration_transitions
        if self.demonstrations is None:
            self._do_without_demonstrations()
            return
        if self.env is None and isinstance(self.observation_space, spaces.Dict):
            return  # only a goal task can turn the demonstrations into its own: ``set_env`` tries again
        limits = self.n_demonstrations, self.n_demonstration_transitions
        try:
            demonstrations = fit_demonstrations(
                self.demonstrations, self.env, self.observation_space, self.action_space, *limits
            )
        except (FileNotFoundError, ImportError, ValueError) as error:
            if not self._is_trained():
                raise
            if isinstance(error, FileNotFoundError) or self.env is None:
                return  # a trained agent acts without them; ``learn`` says what is missing
            kind = ImportError if isinstance(error, ImportError) else ValueError
            raise kind(f"{error}. A trained agent can do without: demonstrations=None") from error
        assert isinstance(self.action_space, spaces.Box)
        self.expert = DemonstrationReplay(demonstrations, self.observation_space, self.action_space, self.memory_history)
        if self.observation_normalization == "demonstrations" and not (self.pretrained or self._awaits_parameters):
            self.actor.normalizer.begin()
            if not self.inputs.are_normalised:
                self.actor.normalizer.fit(self._features_of(self.expert.episodes))

    def _do_without_demonstrations(self) -> None:
        """:raises ValueError: for settings that need them, of an agent that has not learned from any"""
        idle = [name for name in NEED_DEMONSTRATIONS if getattr(self, name)]
        idle += ["observation_normalization"] if self.observation_normalization == "demonstrations" else []
        if idle and not self._is_trained():
            raise ValueError(f"{' and '.join(idle)} need demonstrations=; pass a file or leave them out")
        if idle:  # what these did stays in the circuits
            self.demonstration_fraction = 0.0
            self.n_demonstrations = self.n_demonstration_transitions = None

    def _is_trained(self) -> bool:
        return bool(self.pretrained or self.num_timesteps)

    def _features_of(self, episodes: Episodes) -> th.Tensor:
        """(N, n_features), some at a time: there can be many images."""
        rows = np.array_split(np.arange(len(episodes)), 1 + len(episodes) // 1024)
        parts = [self.inputs.observations(episodes.take(some).observations) for some in rows]
        return th.cat([self.inputs.features(part) for part in parts])

    def _fit_to_bounds(self) -> None:
        """The mean and standard deviation of the lowest and the highest observation map them to -1 and 1."""
        if self.observation_normalization != "bounds":
            return
        space = self.observation_space
        bounds = np.stack([space.low, space.high]) if isinstance(space, spaces.Box) else np.full(1, np.inf)
        if bounds.ndim != 2 or not np.all(np.abs(bounds) < LARGEST_BOUND) or self.inputs.are_normalised:
            raise ValueError(
                f"observation_normalization='bounds' needs a flat Box whose bounds are below {LARGEST_BOUND:g}, and no "
                f"VecNormalize(norm_obs=True): observation_space={space}; where there are no bounds, use "
                "VecNormalize(env, norm_reward=False) with 'none'"
            )
        self.actor.normalizer.begin()
        self.actor.normalizer.fit(self.inputs.features(self.inputs.observations(bounds)))

    def _follow_demonstrations(self) -> None:
        """
        Use those that were set since, or that were put back. A prior and a normaliser that have learned stay as they are.

        :raises ValueError: when they do not fit, or are not there
        """
        if isinstance(self.demonstrations, Path):  # which one system could not unpickle from another
            self.demonstrations = str(self.demonstrations)
        now = self.demonstrations, self.n_demonstrations, self.n_demonstration_transitions
        if self.expert is None or any(mine is not other for mine, other in zip(now, self._followed, strict=True)):
            self._setup_demonstrations()
        if self.expert is None and self.demonstrations is not None:
            raise ValueError(
                f"no demonstrations file at {self.demonstrations}, and learning needs it: put it back, or set "
                "agent.demonstrations"
            )

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As in SB3. Returns of another environment are forgotten; ValueError where demonstrations do not fit."""
        super().set_env(env, force_reset)
        self._steps_at_pause = None
        self.actor_guidance.forget_returns()
        if self.replay_buffer is not None:
            self.replay_buffer.forget_own_episodes()
        if isinstance(self.replay_buffer, HerReplayBuffer):  # SB3 goes on paying by the old one
            assert self.env is not None
            self.replay_buffer.env = self.env
        if self.demonstrations is not None:
            self._setup_demonstrations()
        self._fit_to_bounds()

    @property
    def pretrained(self) -> bool:
        """Whether the actor has imitated the demonstrations (:meth:`pretrain`), or was given synapses that have."""
        return bool(self.policy.has_imitated)

    @property
    def imitates_first(self) -> bool:
        """Whether ``learn`` begins with BC, so that an evaluation before it says nothing."""
        return self.demonstrations is not None and self.guidance != "none" and not self.pretrained

    @property
    def inputs(self) -> CircuitInputs:
        """Turns observations into what the circuits see."""
        return CircuitInputs(self.actor, self._vec_normalize_env)

    @property
    def reward_weights(self) -> tuple[float, float, float]:
        """(α_ext, α_ep, α_in) as used: without demonstrations there is no prior."""
        return self.alpha_ext, self.alpha_ep, 0.0 if self.demonstrations is None else self.alpha_in

    # ------------------------------------------------------------------ before learning: prior and warm start

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        self._check_together()
        self._check_learning_rates()
        if self._steps_at_pause is not None and self._steps_at_pause != self._steps_of_envs():
            self._last_obs = None  # somebody else has played in them, as ``evaluate_policy`` does: they are reset
        if isinstance(self.action_noise, VectorizedActionNoise) and self.action_noise.n_envs != self.n_envs:
            self.action_noise = self.action_noise.base_noise  # of a loaded agent; SB3 makes it one for each environment
        if reset_num_timesteps or self._last_obs is None:  # SB3 resets the environments
            self._rollout_state: tuple[np.ndarray, ...] | None = None
            self._rollout_starts = np.ones(self.n_envs, dtype=bool)
            if self.replay_buffer is not None:
                self.replay_buffer.cut_running_episodes()
            self.actor_guidance.on_reset()
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        self._check_observations(self._last_obs)
        self._follow_demonstrations()
        assert self.replay_buffer is not None
        # one discount and one length of returns for what is replayed and what is shown, of a loaded buffer too
        self.replay_buffer.set_returns(self.n_steps, self.gamma)
        memory = self.replay_buffer.self_imitation
        if memory is not None:
            memory.takes_all = self.actor_guidance.stores == "positive" and self.expert is not None
        self._warn_of_idle_settings()
        if self.verbose:
            print(self.describe(), flush=True)
        self.pretrain(between_updates(result[1]), _shows_progress(result[1]))
        self.start_time = time.time_ns()  # of the frames per second: pre-training has none
        return result

    def _steps_of_envs(self) -> list[int] | None:
        """How many steps each environment has made, whoever acted, and of these in the running episode; None without SB3's
        Monitor, which counts them, or where nobody can be asked for it."""
        assert self.env is not None
        try:
            if not all(self.env.env_is_wrapped(Monitor)):
                return None
            return [*self.env.get_attr("total_steps"), *map(len, self.env.get_attr("rewards"))]
        except (AttributeError, NotImplementedError, TypeError):
            return None

    def _check_together(self) -> None:
        """
        :raises ValueError: for keywords that do not go together: a generator beside a buffer that does not keep what it learns
            to predict, an episode's last observation; returns of several steps of an action that was taken at their beginning;
            episodes of several environments, which do not end together
        """
        if self.alpha_ep and self.optimize_memory_usage:
            raise ValueError(
                f"alpha_ep={self.alpha_ep:g} does not work with optimize_memory_usage=True, which keeps the next episode's "
                "first observation in the place of an episode's last: use optimize_memory_usage=False or alpha_ep=0"
            )
        if self.bootstrap == "literal" and self.n_steps > 1:
            raise ValueError(
                f"n_steps={self.n_steps} does not work with bootstrap='literal', which values the action taken: use n_steps=1"
            )
        every = self.train_freq
        if self.n_envs > 1 and isinstance(every, tuple) and every[1] in ("episode", TrainFrequencyUnit.EPISODE):
            raise ValueError(
                f"train_freq=({every[0]}, 'episode') needs one environment, not n_envs={self.n_envs}: use a number of steps"
            )

    def _warn_of_idle_settings(self) -> None:
        """Warns of a signal that nobody makes, and of an agent that was taught by demonstrations and has none."""
        if self.pretrained and self.demonstrations is None and self.refresh_weight:
            warnings.warn(
                "the agent was taught by demonstrations and goes on without them, so that nothing of them is imitated: pass "
                "demonstrations= again, as from_weights(path, env, demonstrations=...)",
                stacklevel=5,
            )
        if self.alpha_in and self.demonstrations is None:
            warnings.warn(
                f"alpha_in={self.alpha_in:g} pays nothing without demonstrations=, which the prior learns from: rewards are "
                f"alpha_ext={self.alpha_ext:g} times the task's and alpha_ep={self.alpha_ep:g} times the epistemic signal",
                stacklevel=5,
            )

    def describe(self) -> str:
        """What the reward is made of, from which demonstrations, and what is off; ``learn`` prints it with ``verbose=1``."""
        assert self.replay_buffer is not None
        ext, ep, inst = self.reward_weights
        parts = {
            "the task's reward": ext,
            "generator": ep,
            "prior": inst,
            "critic term": self.critic_weight,
            "refresh": self.refresh_weight,
            "self-imitation": self.replay_buffer.self_imitation is not None,
            "demonstrations in the critic's batch": self.demonstration_fraction,
            "working memory": self.memory_history,
        }
        return (
            f"reward: {ext:g} x task (alpha_ext) + {ep:g} x epistemic (alpha_ep) + {inst:g} x instrumental signal (alpha_in)\n"
            f"demonstrations: {'none' if self.expert is None else self.expert.demonstrations!r}\n"
            f"{self.actor_guidance.describe()}\n"
            f"off: {', '.join(name for name, value in parts.items() if not value) or 'nothing'}"
        )

    def pretrain(self, before_update: Callable[[], None] = lambda: None, progress_bar: bool = False) -> None:
        """
        Train the prior on the demonstrations and let guidance start, once; ``learn`` calls this.

        :param before_update: called before each update
        :param progress_bar: show one
        """
        # without a weight the prior has no role
        n_prior = self.prior_updates - int(self.policy.n_prior_updates) if self.alpha_in else 0
        if self.expert is not None and not self.pretrained:
            if self.inputs.are_normalised:
                warnings.warn(
                    "VecNormalize's observation statistics drift under what is learned now, and those of the demonstrations "
                    "(observation_normalization) are not used: use VecNormalize(norm_obs=False)",
                    stacklevel=2,
                )
            self._show_to_vec_normalize()
        for update in _counted(max(n_prior, 0) if self.expert is not None else 0, "prior", progress_bar):
            if self.verbose and not progress_bar and update % PRETRAINING_INTERVAL == 0:
                print(f"pre-training: update {update} of {n_prior}", flush=True)
            before_update()
            self._update_prior(self.policy.batch_size_of("prior", self.batch_size))
            self.policy.n_prior_updates.add_(1)
        self.actor_guidance.on_training_start(self._context(), self.pretrained)
        if self.expert is not None:
            self.policy.has_imitated.fill_(1.0)

    def _context(self) -> GuidanceContext:
        """What guidance may use of this agent."""
        return GuidanceContext(
            actor=self.actor.circuit,
            targets=[self.actor_target],
            n_envs=self.n_envs,
            sample=self.sample_imitated if self._imitated_parts() else None,
            residual_std=self.policy.residual_std,
            selection_circuits=self.policy.selection_circuits(),
        )

    def _imitated_parts(self) -> list[Episodes]:
        """What refresh draws from: the demonstrations and the self-imitation memory."""
        assert self.replay_buffer is not None
        memory = self.replay_buffer.self_imitation
        own = [] if memory is None or memory.episodes is None else [memory.episodes]
        return own if self.expert is None else [self.expert.episodes, *own]

    def sample_imitated(self, n: int) -> ImitationBatch:
        """Features (n, n_features), actions (n, A) and working memory of ``n`` imitated steps."""
        samples = sample_union(self._imitated_parts(), n, self.memory_history, self.actor_guidance.weighting)
        arrays = self.inputs.normalized(samples.observations), samples.actions.astype(np.float32, copy=False)
        observed, actions = to_device(arrays, self.inputs.device)
        memory = self.inputs.memory(*self.inputs.past(samples.history, samples.history_mask))
        return self.inputs.features(observed), actions, memory

    def _show_to_vec_normalize(self) -> None:
        """Its statistics are of the demonstrations before anything learns from these: they have seen one observation else."""
        normalize = self._vec_normalize_env
        if normalize is None or not normalize.norm_obs or not normalize.training:
            return
        assert self.expert is not None
        shown = self.expert.episodes
        for rows in np.array_split(np.arange(len(shown)), 1 + len(shown) // 1024):
            observations = shown.take(rows).observations
            if isinstance(normalize.obs_rms, dict):
                for key, statistics in normalize.obs_rms.items():
                    statistics.update(observations[key])
            else:
                normalize.obs_rms.update(observations)
        if self._last_original_obs is not None:
            self._last_obs = normalize.normalize_obs(self._last_original_obs)

    def _update_prior(self, batch_size: int) -> None:
        assert self.expert is not None
        for group in self.prior.optimizer.param_groups:  # a run before may have ended at another rate
            group["lr"] = self.lr_schedule(1.0) * group["lr_scale"]
        batch = self.expert.sample(batch_size, self.inputs, self.reward_weights, self.gamma)
        state = self.prior.settle(batch.features, batch.next_features, batch.memory)
        self.prior.apply_changes(self.prior.hebbian_update(state))

    # ------------------------------------------------------------------ collecting

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """As in SB3. An exception between the environment's step and its storage loses a transition: the next ``learn`` resets
        the environments."""
        try:
            return super().collect_rollouts(*args, **kwargs)
        except BaseException:
            if self._is_stepping:
                self._last_obs = None
            raise

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        assert self._last_obs is not None
        self._is_stepping = True
        warming_up = self.num_timesteps < learning_starts
        context = self._context()
        if self.memory_history or not warming_up:  # the working memory follows random actions too
            circuits = self.actor_guidance.acting_circuits(context)
            scaled, self._rollout_state = self.actor.roll_out(
                self._last_obs, self._rollout_state, self._rollout_starts, circuits
            )
        if warming_up:
            scaled = self.policy.scale_action(np.array([self.action_space.sample() for _ in range(n_envs)]))
        check_finite("actor", "actions", scaled, self.num_timesteps)
        if action_noise is not None or self.exploration_noise:
            noise = self._exploration_noise(context, scaled.shape) if action_noise is None else action_noise()
            explores = np.array([self.actor_guidance.explores(env) for env in range(n_envs)])
            scaled = np.clip(scaled + explores.reshape(-1, *[1] * (scaled.ndim - 1)) * noise, -1.0, 1.0).astype(np.float32)
        return self.policy.unscale_action(scaled), scaled

    def _exploration_noise(self, context: GuidanceContext, shape: tuple[int, ...]) -> np.ndarray:
        """Gaussian noise in ``shape``, (n_envs, *action_shape)."""
        scale = self.actor_guidance.exploration_scale(context, float(self.exploration_noise)).reshape(shape[1:])
        return np.random.normal(size=shape).astype(np.float32) * scale

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
        score = self._score if any(self.reward_weights[1:]) else None
        assert isinstance(replay_buffer, SignalReplay)
        next_obs, rewards = self._before_auto_reset(new_obs, reward, dones, infos)
        replay_buffer.add(
            self._last_original_obs,
            next_obs,
            buffer_action,
            rewards,
            dones,
            infos,
            score=score,
        )
        self._last_obs = new_obs
        if self._vec_normalize_env is not None:
            self._last_original_obs = self._vec_normalize_env.get_original_obs()
        self._is_stepping = False
        self._rollout_starts = np.array(dones, dtype=bool)
        if self.expert is not None and np.any(dones):
            self.expert.check_scale(replay_buffer.rewards[: replay_buffer.size()])
        if self.num_timesteps >= self.learning_starts + self.n_envs:  # the step that was just made was no random one
            self.actor_guidance.on_step(self._context(), rewards, dones, self._n_updates)
        if ENDLESS in replay_buffer.running_lengths:
            self._warn_of_endless_episodes()

    def _before_auto_reset(
        self, new_obs: Any, reward: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
    ) -> tuple[Any, np.ndarray]:
        """Next observations and rewards as the environment gave them, before VecNormalize and before its reset; copies."""
        normalize = self._vec_normalize_env
        if normalize is None:
            self._last_original_obs, new_original, rewards = self._last_obs, new_obs, reward
        else:
            new_original, rewards = normalize.get_original_obs(), normalize.get_original_reward()
        next_obs = map_observations(np.array, new_original)
        for env in np.flatnonzero(dones):
            terminal = infos[env].get("terminal_observation")
            if terminal is None:
                continue
            if normalize is not None:
                terminal = normalize.unnormalize_obs(terminal)
            if isinstance(next_obs, dict):
                for key in next_obs:
                    next_obs[key][env] = terminal[key]
            else:
                next_obs[env] = terminal
        return next_obs, rewards

    def _warn_of_endless_episodes(self) -> None:
        waits = ["the deployed policy changes with whole episodes"] if self.actor_guidance.has_gate else []
        waits += ["hindsight learns from episodes that have ended"] if isinstance(self.replay_buffer, HerReplayBuffer) else []
        if waits:
            warnings.warn(
                f"an episode has gone on for {ENDLESS} steps: {' and '.join(waits)}, so end them with "
                "gymnasium.wrappers.TimeLimit",
                stacklevel=2,
            )

    def _check_observations(self, observations: Any) -> None:
        with np.errstate(over="ignore"):  # circuits see float32
            seen = map_observations(lambda one: one.astype(np.float32) if one.dtype == np.float64 else one, observations)
        map_observations(lambda array: check_finite("environment", "observations", array, self.num_timesteps), seen)

    def _score(
        self,
        observations: Observations,
        actions: np.ndarray,
        next_observations: Observations,
        past: Observations | None,
        mask: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Both signals of new transitions as they are stored (Algorithm 1, lines 10, 12 and 13), (n_envs,) each."""
        inputs, (_, alpha_ep, alpha_in) = self.inputs, self.reward_weights
        features, next_features = (inputs.features(inputs.observations(o)) for o in (observations, next_observations))
        memory = inputs.memory(*inputs.past(past, mask))
        raw_ep, raw_in = self._raw_signals(features, inputs.tensor(actions), next_features, memory)
        epistemic, instrumental = self.signals.score(raw_ep, raw_in, alpha_ep, alpha_in)
        check_finite("generator", "signals", epistemic, self.num_timesteps)
        check_finite("prior", "signals", instrumental, self.num_timesteps)
        self.diagnostics.follow(epistemic_signal=epistemic.mean(), instrumental_signal=instrumental.mean())
        return (raw_ep, raw_in) if self.signals.normalization == "sampled" else (epistemic, instrumental)

    def _raw_signals(
        self, features: th.Tensor, actions: th.Tensor, next_features: th.Tensor, memory: th.Tensor | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Summed squared errors of generator and prior, (B,) each; zeros where the signal has no weight."""
        _, alpha_ep, alpha_in = self.reward_weights
        epistemic, instrumental = np.zeros((2, len(features)), dtype=np.float32)
        if alpha_ep:
            state = self.generator.settle(th.cat([features, actions], dim=1), next_features, memory)
            epistemic = summed_squared_errors(state, self.signals.errors).cpu().numpy()
        if alpha_in:
            state = self.prior.settle(features, next_features, memory)
            self.diagnostics.settled("prior", state)
            instrumental = summed_squared_errors(state, self.signals.errors).cpu().numpy()
        return epistemic, instrumental

    # ------------------------------------------------------------------ learning

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """
        The updates of Algorithm 1 (lines 17 to 26), ``gradient_steps`` times; with hindsight from the first ended episode on.

        :param gradient_steps: how many updates of every circuit
        :param batch_size: B, of the circuits without one of their own
        """
        if isinstance(self.replay_buffer, CombinedHerReplayBuffer) and not self.replay_buffer.has_episodes:
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate([circuit.optimizer for _, circuit in self.policy.named_circuits()])
        n_actor, n_critic, n_generator = self._batch_sizes(batch_size)
        # Sample the minibatches of all updates together (line 17)
        for batch in self.sample_batches(gradient_steps, batch_size):
            self._n_updates += 1
            self.diagnostics.begin_update(self._n_updates, self.num_timesteps, self.policy_delay)
            # Motor-action circuit: the critic term plus imitation (lines 19 and 26)
            if self._n_updates % self.policy_delay == 0:
                self.update_actor(batch.first(n_actor))
            # Policy circuit: settle on the bootstrapped targets (lines 21 and 22)
            if self.critic_weight:
                self.update_critic(batch.first(n_critic))
            # World model: settle on the next observation (line 24). Without weight in the reward it has no role
            if self.alpha_ep:
                self.update_generator(batch.first(n_generator))
            # Target circuits follow
            if self.target_update_interval == 1:
                self._update_targets(self.tau)
        self._log_training()

    def _batch_sizes(self, batch_size: int) -> tuple[int, int, int]:
        """Of actor, critic and generator."""
        own = self.policy.batch_size_of
        return own("actor", batch_size), own("critic", batch_size), own("generator", batch_size)

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        """SB3's schedule, times what each parameter group asks for (γ_e, a circuit's own learning rate)."""
        super()._update_learning_rate(optimizers)
        for optimizer in optimizers if isinstance(optimizers, Iterable) else [optimizers]:
            for group in optimizer.param_groups:
                group["lr"] *= group["lr_scale"]

    def _rescore_demonstrations(self) -> None:
        """Now and then: the signals of demonstrated transitions under the present generator; the normalisers stay."""
        if self.expert is None or not self.demonstration_fraction or not any(self.reward_weights[1:]):
            return
        if self._n_updates % EXPERT_SIGNALS_INTERVAL == 1 or not self.expert.has_signals:
            self.expert.refresh_signals(self._raw_signals, self.inputs, *self.signals.rescored)

    def sample_batches(self, n_batches: int, batch_size: int) -> Iterator[Batch]:
        """Minibatches of replayed transitions, the newest in each, then the share that comes from the demonstrations."""
        assert self.replay_buffer is not None
        if n_batches < 1:
            return
        self._rescore_demonstrations()
        sizes = self._batch_sizes(batch_size)
        largest, inputs, weights = max(sizes), self.inputs, self.reward_weights
        n_expert = round(self.demonstration_fraction * largest) if self.expert is not None else 0
        n_replayed = largest - n_expert
        n_newest = self.replay_buffer.n_newest(n_replayed)
        signals = self.signals.replayed if any(weights[1:]) else None
        n_drawn = n_newest + n_batches * (n_replayed - n_newest)
        samples = self.replay_buffer.sample(n_drawn, self._vec_normalize_env, signals, n_newest)
        replayed = inputs.replayed(samples, weights, self.gamma)
        # one of these updates may be measured, whose number is known though it has not begun
        updates = range(self._n_updates + 1, self._n_updates + 1 + n_batches)
        if len(samples.rewards) and any(self.diagnostics.is_due(update, self.policy_delay) for update in updates):
            internal = replayed.rewards - weights[0] * samples.rewards
            self.diagnostics.follow(internal_reward=float(internal.mean()), task_reward=float(samples.rewards.mean()))
        demonstrated = None
        if n_expert and self.expert is not None:
            demonstrated = self.expert.sample(n_expert * n_batches, inputs, weights, self.gamma, self.n_steps, signals)
        for index in range(n_batches):
            batch = replayed.minibatch(index, n_replayed, n_newest)
            if demonstrated is not None:
                batch = batch.join(demonstrated.minibatch(index, n_expert))
            # circuits with a smaller batch take its first rows: the newest, then a fair mixture of the rest
            yield batch if min(sizes) == largest else batch.shuffled(keep=n_newest)

    def update_actor(self, batch: Batch) -> None:
        """Critic term (line 19) and imitation term (line 26), added up for one step of the optimizer."""
        actor = self.actor.circuit
        changes = None
        # Imitation: settle on demonstrated actions and those of good episodes, ΔW_i = e φ(z)ᵀ
        imitation_weight = self.refresh_weight * self.actor_guidance.imitation_weight(self._n_updates)
        if imitation_weight and self._imitated_parts():
            state = actor.settle(*self.sample_imitated(len(batch.features)))
            changes = actor.hebbian_update(state).scale_(imitation_weight)
            self.diagnostics.settled("actor", state)
            self.diagnostics.change_norms("imitation", changes)
        # Critic term: actor and critic settle as one under the critic's output error +1/A, ΔW_c = e φ(z)ᵀ
        critic_weight = self.critic_weight * self.actor_guidance.critic_weight(self._n_updates)
        if critic_weight:
            coupled = settle_coupled(actor, self.critic, batch.features, batch.memory, self.policy.nudge)
            improvement = actor.hebbian_update(coupled.actor)
            self.diagnostics.coupled(coupled, improvement, batch.features, batch.memory)
            scale = coupled.action_values.abs().mean().clamp_min(SMALLEST_VALUE_SCALE) if self.normalize_critic_term else 1.0
            improvement.scale_(critic_weight / scale)
            self.diagnostics.change_norms("critic_term", improvement)
            if changes is None:
                self.diagnostics.settled("actor", coupled.actor)
            changes = improvement if changes is None else changes.add_(improvement)
        if changes is not None:
            actor.apply_changes(changes)
            self.actor_guidance.after_update(self._context())

    def update_critic(self, batch: Batch) -> None:
        """All members settle on the same targets."""
        inputs = th.cat([batch.features, batch.actions], dim=1)
        state = self.critic.settle(inputs, self.critic_targets(batch))
        self.diagnostics.settled("critic", state)
        self.critic.apply_changes(self.critic.hebbian_update(state))

    def update_generator(self, batch: Batch) -> None:
        """The generator settles on the next observation."""
        inputs = th.cat([batch.features, batch.actions], dim=1)
        state = self.generator.settle(inputs, batch.next_features, batch.memory)
        self.diagnostics.settled("generator", state)
        self.generator.apply_changes(self.generator.hebbian_update(state))

    def _target_noise(self, actions: th.Tensor) -> th.Tensor:
        """Clipped Gaussian noise on the target actor's actions, (B, A), as in TD3."""
        bound = TARGET_NOISE_CLIP * self.target_policy_noise
        return (th.randn_like(actions) * self.target_policy_noise).clamp(-bound, bound)

    def critic_targets(self, batch: Batch) -> th.Tensor:
        """t = r + γ c, or r alone when terminal; one and the same reward for every action output, (B, A)."""
        if self.bootstrap == "literal":
            next_actions = batch.actions
        else:
            next_actions = self.actor_target.project(batch.bootstrap_features, batch.next_memory)
            if self.target_policy_noise:
                next_actions = (next_actions + self._target_noise(next_actions)).clamp(-1.0, 1.0)
        inputs = th.cat([batch.bootstrap_features, next_actions], dim=1)
        pair = th.randperm(self.n_critics)[:2] if self.n_critics > 2 else None
        values = self.critic_target.project(inputs, members=pair)
        if self.n_critics > 1:
            values = values.amin(0)
        return batch.rewards + (1.0 - batch.dones) * batch.discounts * values

    def _update_targets(self, tau: float) -> None:
        """Move the target circuits by ``tau`` (1 copies)."""
        self.actor_target.move_towards(self.actor.circuit, tau)
        self.critic_target.move_towards(self.critic, tau)

    def _on_step(self) -> None:
        """Moves the targets where that goes by environment steps."""
        interval, now = self.target_update_interval, self.num_timesteps
        if interval > 1 and now // interval > (now - self.n_envs) // interval:
            self._update_targets(self.tau)

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
        for key, value in self.actor_guidance.logs().items():
            self.logger.record(f"train/{key}", value)

    def learn(
        self: SelfActPC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "ActPC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfActPC:
        """As in SB3, after BC pre-training (:meth:`pretrain`) where there are demonstrations; ValueError for a bad number of
        environment steps, and where something that was set since does not fit."""
        check_kind("total_timesteps", total_timesteps, float)
        Between(0)("total_timesteps", total_timesteps)
        super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        self._steps_at_pause = self._steps_of_envs()
        return self

    @classmethod
    def load(cls: type[SelfActPC], path: str | PathLike[str], *args: Any, **kwargs: Any) -> SelfActPC:  # type: ignore[override]
        """
        As in SB3, which unpickles: load files that you trust.

        :raises ValueError: for a file of a version whose classes are not here, or of another algorithm
        """
        own = kwargs.get("policy_kwargs")
        with _named_errors(path):
            try:
                model = super().load(path, *args, **kwargs)  # type: ignore[arg-type]
            except ValueError as error:
                if "policy kwargs do not equal" not in str(error) or not isinstance(own, Mapping) or "is_gated" in own:
                    raise
                try:  # demonstrations had added it
                    model = super().load(path, *args, **{**kwargs, "policy_kwargs": {"is_gated": True, **own}})  # type: ignore[arg-type]
                except ValueError:
                    raise error from None
        return model

    def set_parameters(self, *args: Any, **kwargs: Any) -> None:
        """As in SB3. Returns of the deployed policy say nothing of another one, and a circuit's own learning
        rate is a setting, not a parameter."""
        groups = [group for _, circuit in self.policy.named_circuits() for group in circuit.optimizer.param_groups]
        scales = [group["lr_scale"] for group in groups]
        super().set_parameters(*args, **kwargs)
        groups = [group for _, circuit in self.policy.named_circuits() for group in circuit.optimizer.param_groups]
        for group, scale in zip(groups, scales, strict=True):
            group["lr_scale"] = scale
        if self._awaits_parameters:  # these are the agent's own
            self._awaits_parameters = False
            if self.demonstrations is not None and not self.pretrained:
                self._setup_demonstrations()
            return
        self.actor_guidance.forget_returns()

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
        signals = state["expert_signals"]
        stored, present = (0 if signals is None else len(signals[0])), (0 if self.expert is None else len(self.expert))
        if stored != present:
            raise ValueError(
                f"the checkpoint's agent has {stored} demonstrated transitions, this one {present}: pass the same "
                "demonstrations="
            )
        if self.expert is not None:
            self.expert.epistemic, self.expert.instrumental, self.expert.has_signals = signals
        self._rollout_state, self._rollout_starts = state["rollout_state"], state["rollout_starts"]
        self.signals.restore_checkpoint_state(state["signals"])
        self.diagnostics.values = dict(state["diagnostics"])
        self.actor_guidance.load_state_dict(state["guidance"])

    @classmethod
    def load_checkpoint(cls: type[SelfActPC], path: str | PathLike[str], env: GymEnv | str, **keywords: Any) -> Restored:
        """
        Go on from a checkpoint: see :func:`sb3_actpc.checkpoints.load_checkpoint` and ``continue_learning`` there.

        :param path: a checkpoint, or the folder of several: the newest whole one is taken
        :param env: an environment made as the stopped run's
        :param keywords: constructor keywords that replace the stored ones, such as ``demonstrations``
        """
        return load_checkpoint(cls, path, env, **keywords)

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        """
        As in SB3, which unpickles: load files that you trust.

        :raises ValueError: for a buffer of another algorithm, of as many environments as this agent has not, or of
            observations or actions of another shape
        """
        given = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded = self.replay_buffer
        needed = self.n_envs, get_obs_shape(self.observation_space), get_action_dim(self.action_space)
        held = getattr(loaded, "n_envs", None), getattr(loaded, "obs_shape", None), getattr(loaded, "action_dim", None)
        if isinstance(loaded, SignalReplay) and held == needed:
            loaded.history = self.memory_history
            return
        self.replay_buffer = given
        shapes = "{} environments, observations of {} and {} actions".format
        raise ValueError(
            f"{path} holds a {type(loaded).__name__} of {shapes(*held)}: this agent, of {shapes(*needed)}, needs what "
            "save_replay_buffer of such an ActPC has written"
        )

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
        needing = (*NEED_DEMONSTRATIONS, "observation_normalization")
        return load_weights(cls, path, env, without=() if with_demonstrations else needing, **keywords)

    def _excluded_save_params(self) -> list[str]:
        aliases = ["actor", "critic", "generator", "prior", "actor_target", "critic_target"]
        derived = ["expert", "_followed", "diagnostics", "actor_guidance"]
        derived += ["_awaits_parameters", "_steps_at_pause", "_is_stepping"]
        return [*super()._excluded_save_params(), *aliases, *derived]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names = [name if name != "actor" else "actor.circuit" for name, _ in self.policy.named_circuits()]
        return ["policy", *(f"policy.{name}.optimizer" for name in names)], []


@contextmanager
def _named_errors(path: str | PathLike[str]) -> Iterator[None]:
    """What SB3 stumbles over in a file of another version, or of another algorithm, as a ValueError that says so."""
    try:
        yield
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith("sb3_actpc"):
            raise
        raise ValueError(_OF_ANOTHER_VERSION.format(path=path, why=error)) from error
    except ValueError as error:
        if not str(error).startswith("policy="):
            raise
        raise ValueError(f"{path} holds no ActPC: load it with the class that saved it ({error})") from error
    except RuntimeError as error:
        if "in state_dict" not in str(error):
            raise
        raise ValueError(_OF_ANOTHER_VERSION.format(path=path, why="its policy has other parts")) from error


def _make_guidance(given: ActorGuidance | str, settings: Settings | None) -> ActorGuidance:
    """:raises ValueError: for another name, or keywords that the guidance has not"""
    if isinstance(given, ActorGuidance):
        return given
    if given not in ("default", "none"):
        raise ValueError(f"guidance={given!r} must be None, 'default', 'none' or an ActorGuidance")
    if given == "none":
        return ActorGuidance()
    known = GuidanceConfig.names()
    for name in settings or {}:
        if name not in known:
            raise ValueError(f"guidance_kwargs has {name!r}{nearest(name, known)}; choose from {known}")
    return BehaviorGuidance(GuidanceConfig(**(settings or {})))


def _shows_progress(callback: BaseCallback) -> bool:
    """Whether there is a progress bar among them, asked for by ``progress_bar`` or given."""
    return isinstance(callback, ProgressBarCallback) or any(map(_shows_progress, getattr(callback, "callbacks", ())))


def _counted(n: int, what: str, is_shown: bool, **keywords: Any) -> Iterable[int]:
    """0 to n - 1, with a bar where it is shown; into a file, or a notebook, it is drawn now and then."""
    seldom = is_shown and not sys.stderr.isatty()
    return tqdm(range(n), what, disable=not is_shown, mininterval=5.0 if seldom else 0.1, **keywords)
