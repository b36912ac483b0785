"""Settling: how the latent states and error neurons of a circuit move while its synapses stand still."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch as th

from sb3_actpc.ngc.activations import Activation, Normalized, jacobian_product, normalize
from sb3_actpc.ngc.synapses import add_product, affine

if TYPE_CHECKING:
    from sb3_actpc.ngc.circuit import NGCCircuit

DYNAMICS = ("krylov", "state")
MAX_AUTO_RATE = 0.3  # activations with kinks chatter at larger rates (batch-mean energy rises by 0.1 %)


@dataclass
class SettledState:
    """
    Where a circuit came to rest; all lists in forward order (first layer first).

    Tensors of an ensemble have a leading dimension M of members.

    :param latents: z, L + 1 tensors (B, n): the clamped input, every hidden layer, the clamped (or, when the output's error
        was clamped instead, the predicted) output. The paper counts from the other end: its z^L is ``latents[0]``
    :param activations: φ(z) of the layers that predict, L tensors; ``activations[l]`` is presynaptic to ``weights[l]``
    :param errors: e = z - z̄, L tensors; ``errors[l]`` belongs to the layer that ``weights[l]`` predicts
    :param output_drive: the output's error times g', what reaches the synapses and the layer above (B, n_outputs)
    :param memory: the working memory m_t, (B, n_memory), or None
    :param n_steps: settling steps taken; 0 for a sweep
    """

    latents: list[th.Tensor]
    activations: list[th.Tensor]
    errors: list[th.Tensor]
    output_drive: th.Tensor
    memory: th.Tensor | None
    n_steps: int = 0

    @property
    def postsynaptic(self) -> list[th.Tensor]:
        """The errors as the synapses see them: hidden g is the identity, the output's error is multiplied by g'."""
        return [*self.errors[:-1], self.output_drive]

    def total_discrepancy(self) -> th.Tensor:
        """The energy 1/2 Σ_l ||e_l||^2 of every sample (paper: total discrepancy), (B,), of an ensemble (M, B)."""
        return 0.5 * th.stack([error.square().sum(-1) for error in self.errors]).sum(0)


class SettlingChain:
    """
    The live latents and errors of one circuit, advanced step by step; hidden layers move in place.

    ``dynamics="state"`` is eq. 1 of the paper to the letter. A step has two halves: :meth:`integrate` moves the hidden layers,
    all from the same instant; :meth:`predict` brings predictions and errors up to date. "krylov" goes where that rests in a
    few steps (:mod:`~sb3_actpc.ngc.krylov`): its error neurons are solved for, and the states ride on them (z = z̄ + e).

    Layers that no error has reached yet stand still and cost nothing.

    Shapes are those of one circuit; those of an ensemble have its M members in front, (M, B, n).

    :param circuit: its synapses are used, never changed, and its settings say how the layers move
    :param x: the clamped input, (B, n_inputs)
    :param memory: m_t, (B, n_memory), or None
    """

    def __init__(self, circuit: "NGCCircuit", x: th.Tensor, memory: th.Tensor | None) -> None:
        self.circuit = circuit
        self.synapses = circuit.synapses
        self.memory = memory
        self.biases = self.synapses.layer_biases(memory, circuit.memory_weight)
        self.latents: list[th.Tensor] = [x]
        self.activations: list[th.Tensor] = [x]
        self.normalized: list[Normalized | None] = [None]
        for weights, bias in zip(self.synapses.weights[:-1], self.biases[:-1], strict=True):
            latents = affine(bias, self.activations[-1], weights)
            self.latents.append(latents)
            self.normalized.append(None)
            self.activations.append(th.empty_like(latents))
            self._activate(len(self.latents) - 1)
        self.output_prediction = affine(self.biases[-1], self.activations[-1], self.synapses.weights[-1])
        self.output = circuit.output_activation.apply(self.output_prediction, th.empty_like(self.output_prediction))
        self.n_hidden = len(self.latents) - 1
        self.lowest_reached = self.n_hidden + 1
        self.target: th.Tensor | None = None
        self.n_steps = 0
        self.drive = self.output_prediction  # replaced as soon as the output is clamped
        self.errors: list[th.Tensor] = []

    def _activate(self, layer: int) -> None:
        """Bring φ(z), or φ of the normalized z, of a hidden layer up to date."""
        latents = self.latents[layer]
        if self.circuit.normalization == "layer":
            normalized = normalize(latents)
            self.normalized[layer] = normalized
            latents = normalized.values
        self.activations[layer] = self.circuit.activation.apply(latents, self.activations[layer])

    def damp(self, layer: int, signal: th.Tensor) -> th.Tensor:
        """``signal``, (B, n), which is overwritten, times the transposed derivative of a hidden layer's activation."""
        held = self.latents[layer], self.activations[layer], self.normalized[layer]
        return damped(self.circuit.activation, signal, *held)

    def slope(self, layer: int, move: th.Tensor) -> th.Tensor:
        """How much a hidden layer's activation changes, to first order, when its latents move by ``move``, (B, n)."""
        normalized = self.normalized[layer]
        if normalized is None:
            return self.damp(layer, move.clone())
        change = jacobian_product(move, self.latents[layer], normalized)
        return self.circuit.activation.damp(change, normalized.values, self.activations[layer])

    def start_settling(self) -> None:
        """Give every hidden layer its error neurons (at rest: 0) and its buffers."""
        hidden = self.latents[1:]
        self.errors = [th.zeros_like(z) for z in hidden]
        self.signals = [th.empty_like(z) for z in hidden]
        self.first_prediction = hidden[0].clone() if hidden else self.output_prediction

    def clamp_output(self, target: th.Tensor) -> None:
        """
        Clamp the output layer to ``target`` (B, n_outputs): its error is target - g(z̄), now and after every step.

        :raises ValueError: for a target of another shape, which would be broadcast
        """
        if target.shape != self.output.shape:
            raise ValueError(
                f"target has the shape {tuple(target.shape)}, the circuit's outputs have {tuple(self.output.shape)}; give one "
                "target for each output of each row of the batch"
            )
        self.target = target
        self._refresh_output_error()

    def clamp_output_drive(self, drive: th.Tensor) -> None:
        """Clamp the output's error itself (already multiplied by g'), (B, n_outputs), whatever the circuit predicts."""
        self.drive = drive
        self.output_error = drive

    def drive_of(self, error: th.Tensor) -> th.Tensor:
        """An output error, (B, n_outputs), times g' at the output; the error itself when g is the identity."""
        activation = self.circuit.output_activation
        if activation.name == "identity":
            return error
        return activation.damp(error.clone(), self.output_prediction, self.output)

    def _refresh_output_error(self) -> None:
        assert self.target is not None
        self.output_error = self.target - self.output
        self.drive = self.drive_of(self.output_error)

    def feedback(self, layer: int, below: th.Tensor, exact: bool = False, out: th.Tensor | None = None) -> th.Tensor:
        """
        (E_l e_{l+1}) ⊙ φ'(z_l), what an error ``below``, (B, n_below), tells hidden layer ``layer`` (1 = first) of its own.

        With ``exact`` through W^T and with φ', whatever the circuit uses.
        """
        matrix = self.synapses.feedback_matrix(layer, self.circuit.feedback_scale, tied=exact)
        signal = th.matmul(below, matrix, out=out)
        return self.damp(layer, signal) if exact or not self.circuit.derivative_free else signal

    def integrate(self, rates: Sequence[float]) -> None:
        """One step of eq. 1 for every hidden layer that an error has reached; ``rates`` are the β, first layer first."""
        circuit = self.circuit
        self.lowest_reached = 1 if circuit.leak else max(1, self.lowest_reached - 1)
        for layer in range(self.lowest_reached, self.n_hidden + 1):
            below = self.drive if layer == self.n_hidden else self.errors[layer]
            signal = self.feedback(layer, below, out=self.signals[layer - 1])
            error = self.errors[layer - 1]
            rate = rates[layer - 1]
            if circuit.leak:
                signal.sub_(self.latents[layer], alpha=circuit.leak)
            if layer == 1:  # its prediction is constant: the error moves as the state does
                error.lerp_(signal, rate)
            else:
                self.latents[layer].add_(signal.sub_(error), alpha=rate)

    def predict(self, output: bool = True) -> None:
        """
        Bring states, activations and errors up to date after :meth:`integrate`.

        :param output: also predict the output (needless where its error is clamped)
        """
        for layer in range(self.lowest_reached, self.n_hidden + 1):
            latents = self.latents[layer]
            error = self.errors[layer - 1]
            below = self.activations[layer - 1]
            weights = self.synapses.weights[layer - 1]
            if layer == 1:
                th.add(self.first_prediction, error, out=latents)
            elif self.circuit.dynamics != "state":
                th.add(error, self.biases[layer - 1], out=latents)
                add_product(latents, below, weights.mT)
            else:
                th.sub(latents, self.biases[layer - 1], out=error)
                add_product(error, below, weights.mT, sign=-1.0)
            self._activate(layer)
        if output:
            self._predict_output()

    def activate(self) -> None:
        """Bring activations and output up to date after the hidden latents were set."""
        for layer in range(1, self.n_hidden + 1):
            self._activate(layer)
        self._predict_output()

    def _predict_output(self) -> None:
        self.output_prediction = affine(self.biases[-1], self.activations[-1], self.synapses.weights[-1])
        self.output = self.circuit.output_activation.apply(self.output_prediction, self.output)
        if self.target is not None:
            self._refresh_output_error()

    def sweep(self, exact: bool = False) -> None:
        """
        One ordered pass, e_l = φ'(z_l) ⊙ (E_l e_{l+1}) from the output to the first layer, with the states at projection.

        This is where the error neurons rest under a fixed infinitesimal output error, whatever E is: eq. 1 is
        triangular there. It is also the zero-divergence schedule of the predictive-coding literature (Z-IL: Song et al.,
        2020), and how ago109/active-neural-generative-coding, ``src/model/ngc.py``, updates: every layer's change is taken at
        the step when the error first reaches it. With tied feedback it is, numerically, the gradient of the output's loss;
        with learned error synapses no W^T is used anywhere. With ``exact`` it is that gradient for every circuit.
        """
        self.errors = list(self.latents[1:])
        below = self.drive
        for layer in range(self.n_hidden, 0, -1):
            below = self.feedback(layer, below, exact)
            self.errors[layer - 1] = below

    def state(self) -> SettledState:
        """The state reached so far (tensors are handed over, not copied)."""
        output = self.output if self.target is None else self.target
        return SettledState(
            latents=[*self.latents, output],
            activations=self.activations,
            errors=[*self.errors, self.output_error],
            output_drive=self.drive,
            memory=self.memory,
            n_steps=self.n_steps,
        )


def damped(
    activation: Activation, signal: th.Tensor, latents: th.Tensor, activations: th.Tensor, normalized: Normalized | None
) -> th.Tensor:
    """
    What a signal becomes on its way back through φ and, where latents are normalized, the normalization before it.

    :param signal: (..., B, n); overwritten
    :param latents: z, (..., B, n)
    :param activations: φ(z), or φ of the normalized z
    :param normalized: of ``latents``; None without normalization
    :return: (..., B, n)
    """
    if normalized is None:
        return activation.damp(signal, latents, activations)
    return jacobian_product(activation.damp(signal, normalized.values, activations), latents, normalized)


def largest_norm_(matrix: th.Tensor, vector: th.Tensor, n_iterations: int = 1) -> th.Tensor:
    """
    The largest singular value of a matrix, or of those of all members of an ensemble, by warm-started power iteration.

    :param matrix: (n_out, n_in) or (M, n_out, n_in)
    :param vector: (n_in,) or (M, n_in), the running estimates of right singular vectors; overwritten
    :return: the estimate, 0-d, never above the true value
    """
    norms = []
    for one, direction in zip(matrix.view(-1, *matrix.shape[-2:]), vector.view(-1, vector.shape[-1]), strict=True):
        for _ in range(n_iterations):
            th.mv(one.t(), one @ direction, out=direction)
            direction.div_(th.linalg.vector_norm(direction).clamp_min(1e-30))
        norms.append(th.linalg.vector_norm(one @ direction))
    return th.stack(norms).max()


def settling_rates(forward_norms: list[float], feedback_norms: list[float]) -> list[float]:
    """
    The rates β that ``settling_rate="auto"`` uses, one per hidden layer (first to last).

    1 / (1 + ||W|| ||E||) of the weights below the layer, the local curvature of the energy; at most ``MAX_AUTO_RATE``.
    """
    return [min(MAX_AUTO_RATE, 1.0 / (1.0 + w * e)) for w, e in zip(forward_norms, feedback_norms, strict=True)]
