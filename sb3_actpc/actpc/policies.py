"""The policy object: four NGC circuits (actor, critic, generator, prior), their targets and their optimisers."""

import copy
import inspect
from typing import Annotated, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_actpc.ngc import NGCCircuit, WorkingMemory, check_agreement
from sb3_actpc.utils.arguments import (
    CIRCUITS,
    MAX_CRITICS,
    Between,
    SubclassOf,
    check_circuit,
    check_net_arch,
    check_nudge,
    check_optimizer,
    checked,
)
from sb3_actpc.utils.checks import LARGEST_SIZE, Settings, named_in_errors
from sb3_actpc.utils.constructors import constructor_keywords
from sb3_actpc.utils.nested import map_observations
from sb3_actpc.utils.normalization import ObservationNormalizer

# what circuit_kwargs, actor_kwargs and so on may set; sizes follow from the task
_SIZES = {"self", "n_inputs", "n_outputs", "hidden", "output_activation", "n_memory", "n_feedback_inputs", "n_members"}
CIRCUIT_KEYWORDS = set(inspect.signature(NGCCircuit.__init__).parameters) - _SIZES
PRIOR_NET_ARCH = (512, 256)  # paper: prior of all MuJoCo tasks
NOT_OF_CIRCUITS = ("learning_rate", "batch_size")  # of a circuit's own settings


def check_circuit_class(name: str, given: Any) -> None:
    """:raises ValueError: for anything but a subclass of NGCCircuit, or such for circuits by their names"""
    parts = given if isinstance(given, dict) else {"actor": given}
    if not {*parts} <= {*CIRCUITS}:
        raise ValueError(f"{name}={given!r} must be a class, or a dict of classes for some of {list(CIRCUITS)}")
    for kind in parts.values():
        SubclassOf(NGCCircuit)(name, kind)


class ActPCActor(BasePolicy):
    """
    The motor-action circuit with everything between an observation and its input: extractor, normaliser, working memory.

    :param observation_space: Observation space
    :param action_space: Box with finite bounds
    :param features_extractor: fixed (it is never trained)
    :param memory: working memory, or None
    :param circuit: the motor-action circuit
    :param is_gated: keep a second circuit, the deployed one, which acts
    :param normalize_images: divide image observations by 255
    """

    action_space: spaces.Box

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_extractor: BaseFeaturesExtractor,
        memory: WorkingMemory | None,
        circuit: NGCCircuit,
        is_gated: bool,
        normalize_images: bool,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        features_extractor.eval()  # dropout and running statistics would go on under a finished actor
        self.normalizer = ObservationNormalizer(features_extractor.features_dim)
        self.memory = memory
        self.circuit = circuit
        self.deployed = circuit.projection_copy() if is_gated else None

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        parts = {"features_extractor": self.features_extractor, "memory": self.memory, "circuit": self.circuit}
        return {**data, **parts, "is_gated": self.deployed is not None}

    @property
    def acting(self) -> NGCCircuit:
        """The circuit that acts: the deployed one where there is a deployment gate."""
        return self.circuit if self.deployed is None else self.deployed

    def with_circuit(self, circuit: NGCCircuit) -> "ActPCActor":
        """A view of this policy in which an equal ``circuit`` acts, without a deployment gate."""
        view = copy.copy(self)
        view._modules = {**self._modules, "circuit": circuit}
        view.deployed = None
        return view

    def train(self, mode: bool = True) -> "ActPCActor":
        """Nothing can tell training from acting: circuits have no such mode, and the extractor, which nobody trains, acts."""
        self.training = mode
        return self

    def features(self, observations: PyTorchObs) -> th.Tensor:
        """:param observations: (B, *obs_shape) or a dict of such
        :return: (B, n_features), what every circuit sees of them"""
        with th.no_grad():
            return self.normalizer(self.extract_features(observations, self.features_extractor))

    def past_features(self, history: PyTorchObs | None, mask: th.Tensor | None) -> th.Tensor | None:
        """:param history: (B, H, *obs_shape) or a dict of such, the observations before each row, oldest first; or None
        :param mask: (B, H), 1 where there was one in the same episode; or None
        :return: (B, H, n_features), zero before the episode's start; None without a history"""
        if history is None or mask is None:
            return None
        features = self.features(map_observations(lambda tensor: tensor.flatten(0, 1), history))
        return features.view(*mask.shape, features.shape[1]) * mask[:, :, None]

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:param observations: (B, *obs_shape) or a dict of such
        :return: actions in [-1, 1], (B, A), with an empty working memory"""
        features = self.features(observations)
        memory = None if self.memory is None else features.new_zeros(len(features), self.memory.size)
        return self.acting.project(features, memory)

    def roll_out(
        self,
        observations: PyTorchObs,
        state: tuple[np.ndarray, ...] | None,
        episode_start: np.ndarray | None,
        circuits: list[NGCCircuit],
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        As :meth:`predict`, with a circuit for every environment.

        :param observations: (n_envs, *obs_shape), or a dict of such
        :param state: as for ``predict``
        :param episode_start: as for ``predict``
        :param circuits: n_envs of them
        :return: actions in [-1, 1], (n_envs, *action_shape), and the new state
        :raises ValueError: for a state of another number of environments
        """
        with th.no_grad():
            features = self.features(observations)
            memory = None
            if self.memory is not None:
                shape = len(features), self.memory.history, features.shape[1]
                history = np.zeros(shape, dtype=np.float32) if state is None else state[0].copy()
                if len(history) != len(features):
                    raise ValueError(f"state is of {len(history)} environments, the observations are of {len(features)}")
                if episode_start is not None:
                    history[np.asarray(episode_start, dtype=bool)] = 0.0
                memory = self.memory(th.as_tensor(history, device=self.device))
                state = (np.concatenate([history[:, 1:], features.cpu().numpy()[:, None]], axis=1),)
            actions = th.empty(len(features), circuits[0].sizes[-1], device=features.device)
            for circuit in dict.fromkeys(circuits):
                rows = [row for row, own in enumerate(circuits) if own is circuit]
                actions[rows] = circuit.project(features[rows], None if memory is None else memory[rows])
        return actions.cpu().numpy().reshape(-1, *self.action_space.shape), state

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self(observation)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        SB3's ``predict``. With a working memory ``state`` carries it: one array (n_envs, H, n_features), returned updated.

        As with SB3's recurrent policies, a bare ``predict(obs)`` then acts with an empty memory.
        """
        is_reset = isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], dict)
        if self.memory is None or is_reset:  # SB3 says what is wrong with what ``env.reset`` returns
            return super().predict(observation, state, episode_start, deterministic)
        observations, vectorized = self.obs_to_tensor(observation)
        n_envs = len(next(iter(observations.values())) if isinstance(observations, dict) else observations)
        actions, state = self.roll_out(observations, state, episode_start, [self.acting] * n_envs)
        actions = self.unscale_action(actions)
        return (actions if vectorized else actions[0]), state


class ActPCPolicy(BasePolicy):
    """
    Actor, critic(s), generator and prior with their target circuits; no parameter requires a gradient.

    :param observation_space: Observation space
    :param action_space: Box with finite bounds
    :param lr_schedule: learning rate as a function of the remaining progress; circuits with a ``learning_rate`` of their own
        keep its ratio to the schedule's start
    :param net_arch: hidden sizes of all circuits, or a dict with the keys ``pi``, ``qf``, ``generator`` and ``prior`` (sizes
        left out stay at their defaults: 256 and 256, the prior's 512 and 256)
    :param n_critics: members of the critic ensemble; the smaller value of two, drawn anew for every update, bootstraps, and
        the actor follows the mean of all. 1 for the paper's single critic
    :param circuit_class: a subclass of :class:`~sb3_actpc.ngc.NGCCircuit` for all circuits, or a dict with classes for some
        of ``actor``, ``critic``, ``generator`` and ``prior``
    :param circuit_kwargs: keywords of every circuit
    :param actor_kwargs: the same for the actor alone, and ``learning_rate``, ``batch_size`` and ``output_activation``, "tanh"
        (the paper's and the default) or "clamp" (:mod:`~sb3_actpc.ngc.activations`)
    :param critic_kwargs: the same for the critic
    :param generator_kwargs: the same for the generator
    :param prior_kwargs: the same for the prior
    :param memory_history: H observations in the working memory of actor, generator and prior; 0 for none
    :param nudge: scale of the critic's clamped error while actor and critic settle as one (the paper's is 1); None for an
        infinitesimal one, or 1 with ``dynamics="state"``. A sweep ("scheduled") is always infinitesimal
    :param is_gated: keep a deployed circuit, and those that the deployment gate evaluates (:mod:`sb3_actpc.guidance`); the
        agent sets it
    :param features_extractor_class: fixed features extractor (it is never trained)
    :param features_extractor_kwargs: its keywords
    :param normalize_images: divide image observations by 255
    :param optimizer_class: a ``torch.optim`` class
    :param optimizer_kwargs: its keywords but the learning rate
    :raises ValueError: for observations or keywords that do not fit
    """

    actor: ActPCActor
    action_space: spaces.Box
    has_imitated: th.Tensor
    bc_residual: th.Tensor
    n_prior_updates: th.Tensor

    @checked
    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: Annotated[list[int] | dict[str, list[int]] | None, check_net_arch] = None,
        n_critics: Annotated[int, Between(1, MAX_CRITICS)] = 2,
        circuit_class: Annotated[type[NGCCircuit] | dict[str, type[NGCCircuit]], check_circuit_class] = NGCCircuit,
        circuit_kwargs: Settings | None = None,
        actor_kwargs: Annotated[Settings | None, check_circuit] = None,
        critic_kwargs: Annotated[Settings | None, check_circuit] = None,
        generator_kwargs: Annotated[Settings | None, check_circuit] = None,
        prior_kwargs: Annotated[Settings | None, check_circuit] = None,
        memory_history: Annotated[int, Between(0, LARGEST_SIZE)] = 0,
        is_gated: bool = False,
        nudge: Annotated[float | None, check_nudge] = None,
        features_extractor_class: Annotated[type[BaseFeaturesExtractor], SubclassOf(BaseFeaturesExtractor)] = FlattenExtractor,
        features_extractor_kwargs: Settings | None = None,
        normalize_images: bool = True,
        optimizer_class: Annotated[type[th.optim.Optimizer], check_optimizer] = th.optim.Adam,
        optimizer_kwargs: Settings | None = None,
    ) -> None:
        fitting = "CnnPolicy" if is_image_space(observation_space) else "MlpPolicy"
        if isinstance(observation_space, spaces.Dict):
            fitting = "MultiInputPolicy"
        kinds = {FlattenExtractor: "MlpPolicy", CombinedExtractor: "MultiInputPolicy"}
        if kinds.get(features_extractor_class, fitting) != fitting:
            raise ValueError(f"{type(self).__name__} does not take {observation_space}: use {fitting!r}")
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            normalize_images=normalize_images,
            squash_output=True,
        )
        self.net_arch = net_arch
        self.n_critics = n_critics
        self.memory_history = memory_history
        self.nudge = nudge
        self.circuit_class = circuit_class
        self.circuit_kwargs = dict(circuit_kwargs or {})
        self.actor_kwargs = actor_kwargs
        self.critic_kwargs = critic_kwargs
        self.generator_kwargs = generator_kwargs
        self.prior_kwargs = prior_kwargs
        self.is_gated = is_gated
        self.lr_schedule = lr_schedule
        self._build()

    def _build(self) -> None:
        with named_in_errors(f"features_extractor_kwargs={self.features_extractor_kwargs!r}", AssertionError):
            extractor = self.make_features_extractor()
        extractor.requires_grad_(False)
        n_features = extractor.features_dim
        n_actions = int(np.prod(self.action_space.shape))
        memory = WorkingMemory(n_features, self.memory_history) if self.memory_history else None
        n_memory = memory.size if memory else 0
        circuit = self._make_circuit("actor", n_features, n_actions, n_memory=n_memory)
        spaces_ = self.observation_space, self.action_space
        self.actor = ActPCActor(*spaces_, extractor, memory, circuit, self.is_gated, self.normalize_images)
        n_members = self.n_critics if self.n_critics > 1 else 0
        n_inputs = n_features + n_actions
        self.critic = self._make_circuit("critic", n_inputs, n_actions, n_feedback_inputs=n_actions, n_members=n_members)
        self.generator = self._make_circuit("generator", n_inputs, n_features, n_memory=n_memory)
        self.prior = self._make_circuit("prior", n_features, n_features, n_memory=n_memory)
        check_agreement(self.actor.circuit, self.critic)
        self.actor_target = self.actor.circuit.projection_copy()
        self.critic_target = self.critic.projection_copy()
        # what the demonstrations have taught, which goes where the synapses go; floats, as SB3 expects of parameters
        self.register_buffer("has_imitated", th.tensor(0.0))
        self.register_buffer("n_prior_updates", th.tensor(0.0))
        self.register_buffer("bc_residual", th.tensor(-1.0))  # below 0: not measured
        names = ("average", "challenger", "previous") if self.is_gated else ()
        self.selection = nn.ModuleDict({name: self.actor.circuit.projection_copy() for name in names})
        for name, circuit in self.circuits().items():
            circuit.optimizer = self._make_optimizer(name, circuit)

    def circuits(self) -> dict[str, NGCCircuit]:
        """The circuits that learn: actor, critic, generator, prior."""
        return {"actor": self.actor.circuit, "critic": self.critic, "generator": self.generator, "prior": self.prior}

    def selection_circuits(self) -> dict[str, NGCCircuit] | None:
        """The circuits of the deployment gate: deployed, average, challenger and previous; None without a gate."""
        if self.actor.deployed is None:
            return None
        circuits: Any = dict(self.selection)
        return {"deployed": self.actor.deployed, **circuits}

    def settings_of(self, name: str) -> dict[str, Any]:
        """What a circuit has of its own, such as ``actor_kwargs``."""
        return dict(getattr(self, f"{name}_kwargs") or {})

    def _make_circuit(self, name: str, n_inputs: int, n_outputs: int, **extra: Any) -> NGCCircuit:
        own = self.settings_of(name)
        kind = self.circuit_class.get(name, NGCCircuit) if isinstance(self.circuit_class, dict) else self.circuit_class
        # Hidden sizes: those of all circuits, or of the circuit's key
        hidden: Any = self.net_arch
        if isinstance(hidden, dict):
            hidden = hidden.get({"actor": "pi", "critic": "qf"}.get(name, name))
        if hidden is None:
            hidden = PRIOR_NET_ARCH if name == "prior" else (256, 256)
        # Keywords: ActPC's defaults, those of every circuit, the circuit's own
        default: dict[str, Any] = {"feedback": "learned", "feedback_start": "mirrored", "weight_decay": 0.1}
        is_normalized = name == "critic" and self.circuit_kwargs.get("settling") == "scheduled"
        if is_normalized or name == "prior":
            default["activation"] = "relu"
        if is_normalized:
            default["normalization"] = "layer"
        if name == "actor":
            extra["output_activation"] = own.pop("output_activation", "tanh")
        kwargs = {**default, **self.circuit_kwargs, **{k: own[k] for k in own if k not in NOT_OF_CIRCUITS}}
        known = sorted({*CIRCUIT_KEYWORDS, *constructor_keywords(kind)} - _SIZES)
        if unknown := sorted(set(kwargs) - set(known)):
            raise ValueError(f"circuit_kwargs, {name}_kwargs: a circuit has no keywords {unknown}; choose from {known}")
        return kind(n_inputs, n_outputs, list(hidden), **kwargs, **extra)

    def _make_optimizer(self, name: str, circuit: NGCCircuit) -> th.optim.Optimizer:
        start = self.lr_schedule(1.0)
        own = self.settings_of(name).get("learning_rate")
        scale = 1.0
        if own is not None:
            scale = own / start if start else 0.0  # a loaded policy has no schedule, and does not learn
        groups = circuit.parameter_groups(start * scale if own is None else own)
        for group in groups:
            group["lr_scale"] *= scale
        kwargs = dict(self.optimizer_kwargs)
        if "lr" in kwargs:
            raise ValueError(f"optimizer_kwargs has lr={kwargs['lr']!r}: use learning_rate=, or a circuit's own")
        if self.optimizer_class is th.optim.Adam and not kwargs.keys() & {"foreach", "differentiable"}:
            kwargs.setdefault("fused", True)  # one kernel for all synapses
        with named_in_errors(f"optimizer_kwargs={self.optimizer_kwargs!r}"):
            return self.optimizer_class(groups, **kwargs)

    def batch_sizes(self, default: int) -> dict[str, int]:
        """Batch size of every circuit: its own ``batch_size`` or the agent's."""
        return {name: int(self.settings_of(name).get("batch_size", default)) for name in CIRCUITS}

    def set_learning_rate(self, learning_rate: float) -> None:
        """The agent's learning rate, times what each parameter group asks for (γ_e, a circuit's own learning rate)."""
        for circuit in self.circuits().values():
            for group in circuit.optimizer.param_groups:
                group["lr"] = learning_rate * group["lr_scale"]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = constructor_keywords(ActPCPolicy)
        return {**{name: getattr(self, name) for name in names}, "lr_schedule": self._dummy_schedule}  # not needed to act

    def train(self, mode: bool = True) -> "ActPCPolicy":
        """See :meth:`ActPCActor.train`."""
        self.training = mode
        self.actor.train(mode)
        return self

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.actor(observation)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """SB3's ``predict``; see :meth:`ActPCActor.predict` for the working memory."""
        return self.actor.predict(observation, state, episode_start, deterministic)


MlpPolicy = ActPCPolicy


class CnnPolicy(ActPCPolicy):
    """:class:`ActPCPolicy` for images, which go through SB3's convolutions with fixed random weights."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("features_extractor_class", NatureCNN)
        super().__init__(*args, **kwargs)


class MultiInputPolicy(ActPCPolicy):
    """:class:`ActPCPolicy` for Dict observations; images go through SB3's convolutions with fixed random weights."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("features_extractor_class", CombinedExtractor)
        super().__init__(*args, **kwargs)


POLICIES: dict[str, type[BasePolicy]] = {
    "MlpPolicy": MlpPolicy,
    "CnnPolicy": CnnPolicy,
    "MultiInputPolicy": MultiInputPolicy,
}


def check_policy(name: str, policy: Any) -> None:
    """:raises ValueError: when it is neither the name of a policy nor a subclass of :class:`ActPCPolicy`"""
    if isinstance(policy, str) and policy not in POLICIES:
        raise ValueError(f"{name}={policy!r} must be one of {list(POLICIES)}, or a subclass of {ActPCPolicy.__name__}")
    if not isinstance(policy, str):
        SubclassOf(ActPCPolicy)(name, policy)
