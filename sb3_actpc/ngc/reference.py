"""
The NGC circuit in plain equations (Ororbia & Mali, arXiv 2209.09174, section 2.1): to be read, and to test the fast one by.

Layers are counted from the input, 0 to L. z[0] is clamped to the input, z[L] to the target, and layer l is predicted from
below: z̄[l] = g(φ(z[l-1]) W[l]ᵀ + b[l] + α_m m M[l]ᵀ), e[l] = z[l] - z̄[l]. Rows are the batch. There is no autograd.
"""

import torch as th

from sb3_actpc.ngc.circuit import NGCCircuit

# φ and its derivative
FUNCTIONS = {
    "identity": (lambda z: z, lambda z: th.ones_like(z)),
    "relu": (lambda z: z.clamp_min(0.0), lambda z: (z > 0.0).to(z.dtype)),
    "relu6": (lambda z: z.clamp(0.0, 6.0), lambda z: ((z > 0.0) & (z < 6.0)).to(z.dtype)),
    "tanh": (th.tanh, lambda z: 1.0 - th.tanh(z) ** 2),
}


Layers = list[th.Tensor]


class ReferenceCircuit:
    """
    Settled latents z[0] to z[L] and errors e[1] to e[L], (B, n) each; the last error is multiplied by g' of the output.

    :param circuit: an :class:`~sb3_actpc.ngc.circuit.NGCCircuit` of one member, without normalization; its synapses are used
    """

    def __init__(self, circuit: NGCCircuit) -> None:
        self.circuit = circuit
        self.phi, self.dphi = FUNCTIONS[circuit.activation.name]
        self.g, self.dg = FUNCTIONS[circuit.output_activation.name]
        self.n_layers = len(circuit.weights)

    def feedback(self, layer: int) -> th.Tensor:
        """What carries e[layer + 1] to a hidden layer, (n[layer + 1], n[layer]): λ_e W, or the learned Eᵀ."""
        if self.circuit.feedback == "tied":
            return self.circuit.feedback_scale * self.circuit.weights[layer]
        learned = list(self.circuit.feedback_weights)
        return learned[layer - self.n_layers]

    def prediction(self, layer: int, z: th.Tensor, memory: th.Tensor | None) -> th.Tensor:
        """What layer ``layer`` (1 to L) is expected to be, before g, from the layer below."""
        activity = z if layer == 1 else self.phi(z)
        total = activity @ self.circuit.weights[layer - 1].t() + self.circuit.biases[layer - 1]
        if memory is not None:
            total = total + self.circuit.memory_weight * memory @ self.circuit.memory_weights[layer - 1].t()
        return total

    def project(self, x: th.Tensor, memory: th.Tensor | None = None) -> Layers:
        """Eq. 6, z[l] = z̄[l] from the input on; the output comes last, before g."""
        z = [x]
        for layer in range(1, self.n_layers + 1):
            z.append(self.prediction(layer, z[-1], memory))
        return z

    def errors(self, z: Layers, target: th.Tensor, memory: th.Tensor | None) -> Layers:
        """e[1] to e[L] of the present latents."""
        e = [z[layer] - self.prediction(layer, z[layer - 1], memory) for layer in range(1, self.n_layers)]
        output = self.prediction(self.n_layers, z[self.n_layers - 1], memory)
        return [*e, (target - self.g(output)) * self.dg(output)]

    def settle(
        self, x: th.Tensor, target: th.Tensor, rates: list[float], memory: th.Tensor | None = None
    ) -> tuple[Layers, Layers]:
        """Eq. 1, K times: z[l] += β (-γ z[l] + (e[l+1] Eᵀ) φ'(z[l]) - e[l]), all layers at once."""
        z = self.project(x, memory)
        for _ in range(self.circuit.n_settling_steps):
            e = self.errors(z, target, memory)
            moved = list(z)
            for layer in range(1, self.n_layers):
                drive = (e[layer] @ self.feedback(layer)) * self.dphi(z[layer])
                moved[layer] = z[layer] + rates[layer - 1] * (drive - e[layer - 1] - self.circuit.leak * z[layer])
            z = moved
        return z, self.errors(z, target, memory)

    def sweep(self, x: th.Tensor, target: th.Tensor, memory: th.Tensor | None = None) -> tuple[Layers, Layers]:
        """Scheduled settling: e[l] = (e[l+1] Eᵀ) φ'(z[l]) once from the output to the input, states at projection."""
        z = self.project(x, memory)
        e = [self.errors(z, target, memory)[-1]]
        for layer in range(self.n_layers - 1, 0, -1):
            e.insert(0, (e[0] @ self.feedback(layer)) * self.dphi(z[layer]))
        return z, e

    def changes(self, latents: Layers, errors: Layers) -> Layers:
        """Eq. 4, ΔW[l] = e[l]ᵀ φ(z[l-1]), means over the batch."""
        activities = [latents[0], *(self.phi(z) for z in latents[1:-1])]
        return [e.t() @ activity / len(e) for e, activity in zip(errors, activities, strict=True)]
