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


def synapses(circuit: NGCCircuit, requires_grad: bool = True) -> list[list[th.Tensor]]:
    """Copies of weights and biases that autograd can follow."""
    return [[p.detach().clone().requires_grad_(requires_grad) for p in ps] for ps in (circuit.weights, circuit.biases)]


def energy(circuit: NGCCircuit, weights, biases, latents, target, m=0.0) -> th.Tensor:
    """Sum over the batch of 1/2 Σ ||z - z̄||^2; ``latents`` are the input and the hidden layers."""
    phi, g = FUNCTIONS[circuit.activation.name], FUNCTIONS[circuit.output_activation.name]
    total = th.zeros((), dtype=target.dtype)
    for layer, (w, b) in enumerate(zip(weights, biases, strict=True)):
        prediction = (latents[layer] if layer == 0 else phi(latents[layer])) @ w.t() + b
        last = layer == len(weights) - 1
        below = target if last else latents[layer + 1]
        total = total + 0.5 * (below - (g(prediction) if last else prediction)).square().sum()
    return total


def forward(circuit: NGCCircuit, weights, biases, x) -> th.Tensor:
    """Feed-forward output."""
    phi, g = FUNCTIONS[circuit.activation.name], FUNCTIONS[circuit.output_activation.name]
    for layer, (w, b) in enumerate(zip(weights, biases, strict=True)):
        x = (x if layer == 0 else phi(x)) @ w.t() + b
    return g(x)


def cosine(a: th.Tensor, b: th.Tensor) -> float:
    """Cosine between two tensors taken as vectors."""
    return float((a * b).sum() / (a.norm() * b.norm()))
