"""The policy object: four NGC circuits (actor, critic, generator, prior), their targets and their optimisers."""

import copy
import inspect
import warnings
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
    check_circuit,
    check_extractor,
    check_net_arch,
    check_nudge,
    check_optimizer,
    checked,
)
from sb3_actpc.utils.checks import LARGEST_SIZE, Settings, named_in_errors
from sb3_actpc.utils.constructors import constructor_keywords

# what circuit_kwargs, actor_kwargs and so on may set; sizes follow from the task
_SIZES = {"self", "n_inputs", "n_outputs", "hidden", "output_activation", "n_memory", "n_feedback_inputs", "n_members"}
CIRCUIT_KEYWORDS = set(inspect.signature(NGCCircuit.__init__).parameters) - _SIZES
OBSERVATION_CLIP = 10.0
# standard deviations at least, of a feature that has changed: of its largest size, and at all; a smaller one may be rounding
SMALLEST_CHANGE, SMALLEST_DEVIATION = 1e-4, 1e-7
PRIOR_NET_ARCH = (512, 256)  # paper: prior of all MuJoCo tasks


def check_circuit_class(name: str, given: Any) -> None:
    """:raises ValueError: for anything but a subclass of NGCCircuit, or such for circuits by their names"""
    parts = given if isinstance(given, dict) else dict.fromkeys(CIRCUITS, given)
    for circuit, kind in parts.items():
        if circuit not in CIRCUITS or not isinstance(kind, type) or not issubclass(kind, NGCCircuit):
            raise ValueError(
                f"{name}={given!r} must be a subclass of {NGCCircuit.__name__}, or a dict of such for some of {list(CIRCUITS)}"
            )


class ObservationNormalizer(nn.Module):
    """(o - mean) / std by fixed statistics, clipped to ±10; the identity until :meth:`fit` is called."""

    mean: th.Tensor
    scale: th.Tensor
    clip: th.Tensor

    def __init__(self, n_features: int) -> None:
        super().__init__()
        self.register_buffer("mean", th.zeros(n_features))
        self.register_buffer("scale", th.ones(n_features))
        self.register_buffer("clip", th.full((), float("inf")))

    def begin(self) -> None:
        """As before the first fit: features come as they are."""
        self.mean.zero_()
        self.scale.fill_(1.0)
        self.clip.fill_(float("inf"))

    def fit(self, features: th.Tensor) -> None:
        """:param features: (N, n_features), not normalised, whose mean and standard deviation are used from now on"""
        self.mean.copy_(features.mean(0))
        std = features.std(0, correction=0)
        has_changed = std > (SMALLEST_CHANGE * features.abs().amax(0)).clamp_min(SMALLEST_DEVIATION)
        self.scale.copy_(th.where(has_changed, 1.0 / std, 1.0))  # a feature that never changed says nothing of its scale
        self.clip.fill_(OBSERVATION_CLIP)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:param features: (..., n_features)
        :return: the same shape, normalised"""
        return th.clamp((features - self.mean) * self.scale, -self.clip, self.clip)


class ActPCActor(BasePolicy):
    """
    The motor-action circuit with everything between an observation and its input: extractor, normaliser, working memory.

    :param observation_space: Observation space
    :param action_space: Box with finite bounds
    :param features_extractor: fixed (it is never trained)
    :param net_arch: hidden sizes
    :param circuit_kwargs: keywords of :class:`~sb3_actpc.ngc.NGCCircuit`
    :param circuit_class: the class of the circuit
    :param memory_history: H observations in the working memory; 0 for none
    :param is_gated: keep a second circuit, the deployed one, which acts
    :param normalize_images: divide image observations by 255
    """

    action_space: spaces.Box

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_extractor: BaseFeaturesExtractor,
        net_arch: list[int],
        circuit_kwargs: dict[str, Any],
        circuit_class: type[NGCCircuit] = NGCCircuit,
        memory_history: int = 0,
        is_gated: bool = False,
        normalize_images: bool = True,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        features_extractor.eval()  # dropout and running statistics would go on under a finished actor
        n_features = features_extractor.features_dim
        self.net_arch = list(net_arch)
        self.circuit_kwargs = circuit_kwargs
        self.circuit_class = circuit_class
        self.memory_history = memory_history
        self.normalizer = ObservationNormalizer(n_features)
        self.memory = WorkingMemory(n_features, memory_history) if memory_history else None
        self.circuit = circuit_class(
            n_features,
            int(np.prod(action_space.shape)),
            self.net_arch,
            output_activation="tanh",
            n_memory=self.memory.size if self.memory else 0,
            **circuit_kwargs,
        )
        self.deployed = self.circuit.projection_copy() if is_gated else None
        self._warned_of_empty_memory = False

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            features_extractor=self.features_extractor,
            net_arch=self.net_arch,
            circuit_kwargs=self.circuit_kwargs,
            circuit_class=self.circuit_class,
            memory_history=self.memory_history,
            is_gated=self.deployed is not None,
        )
        return data

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

    def forward(self, observations: PyTorchObs, history: th.Tensor | None = None) -> th.Tensor:
        """:param observations: (B, *obs_shape) or a dict of such
        :param history: (B, H, n_features) for a working memory, zeros before the episode's start
        :return: actions in [-1, 1], (B, A)"""
        features = self.features(observations)
        if self.memory is None:
            return self.acting.project(features)
        if history is None:
            history = features.new_zeros(len(features), self.memory_history, features.shape[1])
        return self.acting.project(features, self.memory(history))

    def roll_out(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None,
        episode_start: np.ndarray | None,
        circuits: list[NGCCircuit],
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        As :meth:`predict`, with a circuit for every environment.

        :param observation: (n_envs, *obs_shape), or a dict of such
        :param state: as for ``predict``
        :param episode_start: as for ``predict``
        :param circuits: n_envs of them
        :return: actions in [-1, 1], (n_envs, *action_shape), and the new state
        """
        self.set_training_mode(False)
        with th.no_grad():
            features = self.features(self.obs_to_tensor(observation)[0])
            memory = None
            if self.memory is not None:
                memory, state = self._remember(features, state, episode_start)
            actions = th.empty(len(features), circuits[0].sizes[-1], device=features.device)
            for circuit in dict.fromkeys(circuits):
                rows = [row for row, own in enumerate(circuits) if own is circuit]
                actions[rows] = circuit.project(features[rows], None if memory is None else memory[rows])
        return actions.cpu().numpy().reshape(-1, *self.action_space.shape), state

    def _remember(
        self, features: th.Tensor, state: tuple[np.ndarray, ...] | None, episode_start: np.ndarray | None
    ) -> tuple[th.Tensor, tuple[np.ndarray, ...]]:
        """m_t of the observations before these, (n_envs, n_memory), and the state with these among them."""
        assert self.memory is not None
        shape = (len(features), self.memory_history, features.shape[1])
        history = np.zeros(shape, dtype=np.float32) if state is None else state[0].copy()
        if len(history) != len(features):
            raise ValueError(
                f"state is of {len(history)} environments, the observations are of {len(features)}: pass the state that "
                "predict returned for the same environments, or state=None where they begin"
            )
        if episode_start is not None:
            history[np.asarray(episode_start, dtype=bool)] = 0.0
        memory = self.memory(th.as_tensor(history, device=self.device))
        return memory, (np.concatenate([history[:, 1:], features.cpu().numpy()[:, None]], axis=1),)

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

        A bare ``predict(obs)`` then acts with an empty memory and warns once.
        """
        if self.memory is None:
            return super().predict(observation, state, episode_start, deterministic)
        if state is None and episode_start is None and not self._warned_of_empty_memory:
            warnings.warn(
                "This agent has a working memory: predict(obs) acts with an empty one. Pass the returned state and "
                "episode_start back in, as with SB3's recurrent policies.",
                stacklevel=3,
            )
            self._warned_of_empty_memory = True
        self.set_training_mode(False)
        observations, vectorized = self.obs_to_tensor(observation)
        with th.no_grad():
            features = self.features(observations)
            memory, state = self._remember(features, state, episode_start)
            actions = self.acting.project(features, memory).cpu().numpy()
        actions = self.unscale_action(actions.reshape(-1, *self.action_space.shape))
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
    :param actor_kwargs: the same for the actor alone, and ``net_arch``, ``learning_rate``, ``batch_size``
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
        features_extractor_class: Annotated[type[BaseFeaturesExtractor], check_extractor] = FlattenExtractor,
        features_extractor_kwargs: Settings | None = None,
        normalize_images: bool = True,
        optimizer_class: Annotated[type[th.optim.Optimizer], check_optimizer] = th.optim.Adam,
        optimizer_kwargs: Settings | None = None,
    ) -> None:
        if features_extractor_class is FlattenExtractor and isinstance(observation_space, spaces.Dict):
            raise ValueError(f"{type(self).__name__} does not take Dict observations: use 'MultiInputPolicy'")
        if features_extractor_class is CombinedExtractor and not isinstance(observation_space, spaces.Dict):
            fitting = "CnnPolicy" if is_image_space(observation_space) else "MlpPolicy"
            raise ValueError(f"{type(self).__name__} is for Dict observations, not {observation_space}: use {fitting!r}")
        if features_extractor_class is FlattenExtractor and is_image_space(observation_space):
            raise ValueError(
                f"observations of shape {observation_space.shape} are images: ActPC learns no convolutions; use "
                "'CnnPolicy' (fixed random ones), policy_kwargs=dict(features_extractor_class=...) or vector observations"
            )
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
        self.circuit_class = circuit_class
        self.circuit_kwargs = dict(circuit_kwargs or {})
        self.kwargs_of = dict(zip(CIRCUITS, (actor_kwargs, critic_kwargs, generator_kwargs, prior_kwargs), strict=True))
        self.is_gated = is_gated
        self.nudge = nudge
        self.lr_schedule = lr_schedule
        self._build()

    def _build(self) -> None:
        with named_in_errors(f"features_extractor_kwargs={self.features_extractor_kwargs!r}", AssertionError):
            extractor = self.make_features_extractor()
        extractor.requires_grad_(False)
        arch = self._net_arch_of("actor")
        kwargs = self._circuit_kwargs_of("actor")
        self.actor = ActPCActor(
            self.observation_space,
            self.action_space,
            extractor,
            arch,
            kwargs,
            self._circuit_class_of("actor"),
            self.memory_history,
            self.is_gated,
            self.normalize_images,
        )
        n_features = extractor.features_dim
        n_actions = int(np.prod(self.action_space.shape))
        n_memory = self.actor.memory.size if self.actor.memory else 0
        n_members = self.n_critics if self.n_critics > 1 else 0
        self.critic = self._circuit(
            "critic", n_features + n_actions, n_actions, n_feedback_inputs=n_actions, n_members=n_members
        )
        self.generator = self._circuit("generator", n_features + n_actions, n_features, n_memory=n_memory)
        self.prior = self._circuit("prior", n_features, n_features, n_memory=n_memory)
        check_agreement(self.actor.circuit, self.critic)
        self.actor_target = self.actor.circuit.projection_copy()
        self.critic_target = self.critic.projection_copy()
        # what the demonstrations have taught, which goes where the synapses go; floats, as SB3 expects of parameters
        self.register_buffer("has_imitated", th.tensor(0.0))
        self.register_buffer("n_prior_updates", th.tensor(0.0))
        names = ("average", "challenger", "previous") if self.is_gated else ()
        self.selection = nn.ModuleDict({name: self.actor.circuit.projection_copy() for name in names})
        for name, circuit in self.named_circuits():
            circuit.optimizer = self._optimizer(name.partition(".")[0], circuit)

    def named_circuits(self) -> list[tuple[str, NGCCircuit]]:
        """The circuits that learn, with their names: actor, critic, generator, prior."""
        others = [("critic", self.critic), ("generator", self.generator), ("prior", self.prior)]
        return [("actor", self.actor.circuit), *others]

    def selection_circuits(self) -> dict[str, NGCCircuit] | None:
        """The circuits of the deployment gate: deployed, average, challenger and previous; None without a gate."""
        if self.actor.deployed is None:
            return None
        circuits: dict[str, NGCCircuit] = {"deployed": self.actor.deployed}
        for name in self.selection:
            circuit = self.selection[name]
            assert isinstance(circuit, NGCCircuit)
            circuits[name] = circuit
        return circuits

    def _settings_of(self, name: str) -> dict[str, Any]:
        return dict(self.kwargs_of[name] or {})

    def _net_arch_of(self, name: str) -> list[int]:
        default = list(PRIOR_NET_ARCH) if name == "prior" else [256, 256]
        own = self._settings_of(name).get("net_arch")
        if own is not None:
            return list(own)
        if isinstance(self.net_arch, dict):
            return list(self.net_arch.get({"actor": "pi", "critic": "qf"}.get(name, name), default))
        return default if self.net_arch is None else list(self.net_arch)

    def _circuit_kwargs_of(self, name: str) -> dict[str, Any]:
        default: dict[str, Any] = {"feedback": "learned", "feedback_start": "mirrored", "weight_decay": 0.1}
        if name == "prior":
            default["activation"] = "relu"
        if name == "critic" and self.circuit_kwargs.get("settling") == "scheduled":
            default |= {"normalization": "layer", "activation": "relu"}
        own = {k: v for k, v in self._settings_of(name).items() if k not in ("net_arch", "learning_rate", "batch_size")}
        kwargs = {**default, **self.circuit_kwargs, **own}
        known = sorted({*CIRCUIT_KEYWORDS, *constructor_keywords(self._circuit_class_of(name))} - _SIZES)
        unknown = sorted(set(kwargs) - set(known))
        if unknown:
            raise ValueError(f"circuit_kwargs, {name}_kwargs: a circuit has no keywords {unknown}; choose from {known}")
        return kwargs

    def _circuit(self, name: str, n_inputs: int, n_outputs: int, **extra: Any) -> NGCCircuit:
        kind = self._circuit_class_of(name)
        return kind(n_inputs, n_outputs, self._net_arch_of(name), **self._circuit_kwargs_of(name), **extra)

    def _circuit_class_of(self, name: str) -> type[NGCCircuit]:
        if isinstance(self.circuit_class, dict):
            return self.circuit_class.get(name, NGCCircuit)
        return self.circuit_class

    def _optimizer(self, name: str, circuit: NGCCircuit) -> th.optim.Optimizer:
        start, own = self.lr_schedule(1.0), self._settings_of(name).get("learning_rate")
        scale = 1.0
        if own is not None:
            scale = own / start if start else 0.0  # a loaded policy has no schedule, and does not learn
        groups = circuit.parameter_groups(start * scale if own is None else own)
        for group in groups:
            group["lr_scale"] *= scale
        kwargs = dict(self.optimizer_kwargs)
        if "lr" in kwargs:
            raise ValueError(
                f"optimizer_kwargs has lr={kwargs['lr']!r}: use learning_rate=, or a circuit's own, as in actor_kwargs"
            )
        if self.optimizer_class is th.optim.Adam and not kwargs.keys() & {"foreach", "differentiable"}:
            kwargs.setdefault("fused", True)  # one kernel for all synapses
        with named_in_errors(f"optimizer_kwargs={self.optimizer_kwargs!r}"):
            return self.optimizer_class(groups, **kwargs)

    def batch_sizes(self, default: int) -> dict[str, int]:
        """Batch size of every circuit: its own ``batch_size`` or the agent's."""
        return {name: int((own or {}).get("batch_size", default)) for name, own in self.kwargs_of.items()}

    def set_learning_rate(self, learning_rate: float) -> None:
        """The agent's learning rate, times what each parameter group asks for (γ_e, a circuit's own learning rate)."""
        for _, circuit in self.named_circuits():
            for group in circuit.optimizer.param_groups:
                group["lr"] = learning_rate * group["lr_scale"]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            lr_schedule=self._dummy_schedule,  # not needed to act
            net_arch=self.net_arch,
            n_critics=self.n_critics,
            circuit_class=self.circuit_class,
            circuit_kwargs=self.circuit_kwargs,
            memory_history=self.memory_history,
            is_gated=self.is_gated,
            nudge=self.nudge,
            optimizer_class=self.optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
            features_extractor_class=self.features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
            **{f"{name}_kwargs": self.kwargs_of[name] for name in CIRCUITS},
        )
        return data

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
