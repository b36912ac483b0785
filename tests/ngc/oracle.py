"""The autograd oracle: energies and losses of a circuit written with torch's own functions, differentiable."""

import torch as th
import torch.nn.functional as F

from sb3_actpc.ngc import NGCCircuit

FUNCTIONS = {
    "relu": F.relu,
    "relu6": F.relu6,
    "tanh": th.tanh,
    "elu": F.elu,
    "leaky_relu": F.leaky_relu,
    "identity": lambda z: z,
}


def synapses(circuit: NGCCircuit, requires_grad: bool = True, member: int | None = None) -> list[list[th.Tensor]]:
    """Copies of weights and biases, of a circuit or of one member of an ensemble, that autograd can follow."""
    kinds = [list(circuit.weights), list(circuit.biases)]
    if member is not None:
        kinds = [[p[member] for p in circuit.weights], [p[member].flatten() for p in circuit.biases]]
    return [[p.detach().clone().requires_grad_(requires_grad) for p in kind] for kind in kinds]


def energy(circuit: NGCCircuit, weights, biases, latents, target) -> th.Tensor:
    """Sum over the batch of 1/2 Σ ||z - z̄||^2; ``latents`` are the input and the hidden layers."""
    phi = FUNCTIONS[circuit.activation.name]
    total = th.zeros((), dtype=target.dtype)
    for layer, (w, b) in enumerate(zip(weights, biases, strict=True)):
        prediction = (latents[layer] if layer == 0 else phi(latents[layer])) @ w.t() + b
        if layer == len(weights) - 1:
            error = target - FUNCTIONS[circuit.output_activation.name](prediction)
        else:
            error = latents[layer + 1] - prediction
        total = total + 0.5 * error.square().sum()
    return total


def forward(circuit: NGCCircuit, weights, biases, x, output_activation: str | None = None) -> th.Tensor:
    """Feed-forward output; with another ``output_activation`` than the circuit's if one is given."""
    for layer, (w, b) in enumerate(zip(weights, biases, strict=True)):
        if layer and circuit.normalization == "layer":
            x = F.layer_norm(x, x.shape[-1:])
        if layer:
            x = FUNCTIONS[circuit.activation.name](x)
        x = x @ w.t() + b
    return FUNCTIONS[output_activation or circuit.output_activation.name](x)


def cosine(a: th.Tensor, b: th.Tensor) -> float:
    """Cosine between two tensors taken as vectors."""
    return float((a * b).sum() / (a.norm() * b.norm()))
