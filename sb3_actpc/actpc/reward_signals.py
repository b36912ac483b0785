"""The internal reward: epistemic and instrumental signals from the errors of settled circuits, and their normalisers."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch as th

from sb3_actpc.actpc.batches import Batch
from sb3_actpc.actpc.diagnostics import Diagnostics
from sb3_actpc.ngc import NGCCircuit, SettledState
from sb3_actpc.utils.arguments import Between, Count, SubclassOf, checked
from sb3_actpc.utils.checks import check_kind

Normalize = Callable[[np.ndarray], np.ndarray]  # element by element, in any shape
STORED: tuple[Normalize, Normalize] = (np.asarray, np.asarray)  # both signals pay what was stored


class RewardWeights(NamedTuple):
    """Weights of the parts of the reward: α_ep and α_in of the signals (paper, Algorithm 1, line 14), α_ext of the task's."""

    task: float = 1.0
    epistemic: float = 0.0
    instrumental: float = 0.0

    @property
    def has_signals(self) -> bool:
        """Whether a signal has a part in the reward."""
        return bool(self.epistemic or self.instrumental)


def check_reward_weights(name: str, weights: Mapping[str, Any] | None) -> None:
    """:raises ValueError: for another key than those of :class:`RewardWeights`, no number, or a negative weight of a signal"""
    if weights is not None and not isinstance(weights, Mapping):
        raise ValueError(f"{name}={weights!r} must be a dictionary with keys from {list(RewardWeights._fields)}")
    for key, value in (weights or {}).items():
        if key not in RewardWeights._fields:
            raise ValueError(f"{name} has an unknown key {key!r}: choose from {list(RewardWeights._fields)}")
        check_kind(f"{name}[{key!r}]", value, float)
        if key != "task":
            Between(0)(f"{name}[{key!r}]", value)


def summed_squared_errors(state: SettledState, which: str = "all") -> th.Tensor:
    """r̂ = Σ_l ||e^l||^2, (B,), the sum that both signals start from (paper, eqs. for r̂^ep and r̂^in): over "all" layers of a
    settled circuit, or the "output" layer alone. Under "scheduled" the errors are those that first arrive."""
    errors = state.errors if which == "all" else state.errors[-1:]
    return th.stack([error.square().sum(1) for error in errors]).sum(0)


class RewardSignal(ABC):
    """
    An internal reward: how a transition is scored, and how the signal learns. Normalizers and weights are the agent's.

    What a signal learns is saved with the agent when the signal is an ``nn.Module`` too.

    :param circuit: the generator for the epistemic signal, the prior for the instrumental one; both know the sizes
    :param diagnostics: takes what is logged
    :param errors: whether the squared errors of "all" layers are summed, or those of the "output"
    """

    def __init__(self, circuit: NGCCircuit, diagnostics: Diagnostics, errors: str = "all") -> None:
        super().__init__()
        self.diagnostics = diagnostics
        self.errors = errors

    @abstractmethod
    def score(self, batch: Batch) -> th.Tensor:
        """
        r̂ of transitions, before it is normalized.

        :param batch: B transitions
        :return: (B,), not negative
        """

    @abstractmethod
    def update(self, batch: Batch) -> None:
        """One update on a batch of transitions."""


class CircuitSignal(RewardSignal):
    """A signal of one of the policy's circuits, which is saved there."""

    def __init__(self, circuit: NGCCircuit, diagnostics: Diagnostics, errors: str = "all") -> None:
        super().__init__(circuit, diagnostics, errors)
        self.circuit = circuit


class GeneratorSurprise(CircuitSignal):
    """The epistemic signal: how badly the generator predicts the next observation (Algorithm 1, lines 10, 12 and 24)."""

    def score(self, batch: Batch) -> th.Tensor:
        """The summed squared errors of the settled generator."""
        return summed_squared_errors(self._settle(batch), self.errors)

    def update(self, batch: Batch) -> None:
        """The generator settles on the next observation and changes: ΔW = e φ(z)ᵀ."""
        state = self._settle(batch)
        self.diagnostics.settled("generator", state)
        self.circuit.apply_changes(self.circuit.hebbian_update(state))

    def _settle(self, batch: Batch) -> SettledState:
        inputs = th.cat([batch.features, batch.actions], dim=1)
        return self.circuit.settle(inputs, batch.next_features, batch.memory)


class PriorError(CircuitSignal):
    """The instrumental signal: how far a step is from the demonstrated ones (Algorithm 1, lines 10 and 13)."""

    def score(self, batch: Batch) -> th.Tensor:
        """The summed squared errors of the settled prior."""
        state = self.circuit.settle(batch.features, batch.next_features, batch.memory)
        self.diagnostics.settled("prior", state)
        return summed_squared_errors(state, self.errors)

    def update(self, batch: Batch) -> None:
        """The prior settles on the demonstrated next observation and changes; only before learning, then it is frozen."""
        state = self.circuit.settle(batch.features, batch.next_features, batch.memory)
        self.circuit.apply_changes(self.circuit.hebbian_update(state))


def instrumental_reward(normalized: np.ndarray, form: str = "penalty") -> np.ndarray:
    """What the prior's normalised errors are worth.

    :param normalized: any shape, in [0, 1], 0 where the step was as demonstrated
    :param form: "penalty", -r in [-1, 0] (the paper's equation; never positive, so that the shortest episode is the best where
        the task can end by falling), or "unit", 1 - r in [0, 1] (the paper's sentence below it; 1 for a step as demonstrated)
    :return: of the same shape
    """
    return 1.0 - normalized if form == "unit" else -normalized


class RunningMaximum:
    """r = r̂ / max(1, r̂_1, ..., r̂_t), the paper's normaliser (Algorithm 1, lines 4, 12 and 13): the maximum starts at 1."""

    def __init__(self) -> None:
        self.maximum = 1.0

    def __call__(self, raw: np.ndarray) -> np.ndarray:
        """(n_envs,) in [0, 1], of (n_envs,) new values r̂ >= 0, which the maximum follows."""
        self.maximum = max(self.maximum, float(raw.max()))
        return raw / self.maximum

    def rescale(self, raw: np.ndarray) -> np.ndarray:
        """Normalise without moving the maximum; values above it count as 1."""
        return np.minimum(raw / self.maximum, 1.0)


class RunningQuantile:
    """r = min(1, r̂ / q), where q follows the 0.9 quantile of r̂ by stochastic approximation on the log scale.

    A single outlier moves q by a step, where it would hold down the running maximum for ever.
    """

    def __init__(self, quantile: float = 0.9, step: float = 0.02) -> None:
        self.quantile = quantile
        self.step = step
        self.estimate = 0.0

    def __call__(self, raw: np.ndarray) -> np.ndarray:
        """(n_envs,) in [0, 1], of (n_envs,) new values r̂ >= 0, which the quantile follows."""
        for value in raw:
            if self.estimate == 0.0:
                self.estimate = max(float(value), 1e-12)
            above = float(value > self.estimate)
            self.estimate *= float(np.exp(self.step * (above - (1.0 - self.quantile))))
        return self.rescale(raw)

    def rescale(self, raw: np.ndarray) -> np.ndarray:
        """Normalise without moving the quantile."""
        return np.minimum(raw / max(self.estimate, 1e-12), 1.0)


class InternalSignals:
    """What both signals are made of, and what their normalisers have seen.

    :param normalizer: "quantile" (:class:`RunningQuantile`) or "max" (running maximum, the paper: the first transitions set
        it, and signals soon are near zero)
    :param normalization: "sampled" (whenever a transition is replayed, by what the normalisers have seen until then) or
        "stored" (once, when it is seen, the paper)
    :param instrumental_form: see :func:`instrumental_reward`
    :param errors: the squared errors of "all" layers are summed (the paper) or of the "output" alone
    :param epistemic_class: what scores how new a transition is
    :param instrumental_class: what scores how far a transition is from the demonstrations
    :param prior_updates: updates of the prior before learning starts, where the instrumental signal has a weight; then it is
        frozen
    :raises ValueError: for another value
    """

    @checked
    def __init__(
        self,
        normalizer: Literal["quantile", "max"] = "quantile",
        normalization: Literal["sampled", "stored"] = "sampled",
        instrumental_form: Literal["penalty", "unit"] = "penalty",
        errors: Literal["all", "output"] = "all",
        epistemic_class: Annotated[type[RewardSignal], SubclassOf(RewardSignal)] = GeneratorSurprise,
        instrumental_class: Annotated[type[RewardSignal], SubclassOf(RewardSignal)] = PriorError,
        prior_updates: Count = 2000,
    ) -> None:
        self.settings = normalizer, normalization, instrumental_form, errors, epistemic_class, instrumental_class
        kind: type[RunningMaximum | RunningQuantile] = RunningMaximum if normalizer == "max" else RunningQuantile
        self.epistemic = kind()
        self.instrumental = kind()
        self.normalization = normalization
        self.instrumental_form = instrumental_form
        self.errors = errors
        self.epistemic_class = epistemic_class
        self.instrumental_class = instrumental_class
        self.prior_updates = prior_updates

    def score(self, epistemic: np.ndarray, instrumental: np.ndarray, weights: RewardWeights) -> tuple[np.ndarray, np.ndarray]:
        """What the summed squared errors r̂ of generator and prior pay, (n_envs,) each; the normalisers follow them, and a
        signal without weight stays as it is."""
        if weights.epistemic:
            epistemic = self.epistemic(epistemic)
        if weights.instrumental:
            instrumental = instrumental_reward(self.instrumental(instrumental), self.instrumental_form)
        return epistemic, instrumental

    @property
    def rewards_of_errors(self) -> tuple[Normalize, Normalize]:
        """What summed squared errors of generator and prior pay by what the normalisers have seen; these do not move."""
        rescale = self.instrumental.rescale
        return self.epistemic.rescale, lambda raw: instrumental_reward(rescale(raw), self.instrumental_form)

    @property
    def replayed(self) -> tuple[Normalize, Normalize]:
        """What stored signals pay when they are replayed."""
        return self.rewards_of_errors if self.normalization == "sampled" else STORED

    @property
    def rescored(self) -> tuple[Normalize, Normalize]:
        """What is stored of signals that are computed anew."""
        return STORED if self.normalization == "sampled" else self.rewards_of_errors

    def checkpoint_state(self) -> list[dict[str, Any]]:
        """What the normalisers have seen."""
        return [dict(vars(self.epistemic)), dict(vars(self.instrumental))]

    def restore_checkpoint_state(self, state: list[dict[str, Any]]) -> None:
        """:param state: what :meth:`checkpoint_state` returned"""
        for normalizer, values in zip((self.epistemic, self.instrumental), state, strict=True):
            vars(normalizer).update(values)
