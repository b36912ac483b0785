"""The synapses of a circuit as plain tensors: what a layer predicts, the way an error takes back, and their products."""

from typing import NamedTuple

import torch as th


class Synapses(NamedTuple):
    """
    The parameters of a circuit as plain lists, in forward order: indexing a ``ParameterList`` is slow.

    An ensemble of M members has a leading dimension M everywhere.

    :param weights: W, each (n_out, n_in)
    :param biases: b, each (n_out,), of an ensemble (M, 1, n_out)
    :param memory: M, each (n_out, n_memory); empty without a working memory
    :param feedback: E^T in the layout of W, so that ``errors @ E^T`` is one product without a transposition; empty where the
        feedback is tied, and else without the input's (or with that of its last columns, where errors reach them)
    """

    weights: list[th.Tensor]
    biases: list[th.Tensor]
    memory: list[th.Tensor]
    feedback: list[th.Tensor]

    def layer_biases(self, memory: th.Tensor | None, memory_weight: float) -> list[th.Tensor]:
        """
        What every layer's prediction adds to W φ(z): b (n_out,), or with a memory that counts b + α_m M m_t, (B, n_out).

        :raises ValueError: when a memory is missing, not wanted or of the wrong size
        """
        n_memory = self.memory[0].shape[1] if self.memory else 0
        fits = not n_memory if memory is None else bool(n_memory) and memory.dim() == 2 and memory.shape[1] == n_memory
        if not fits:
            found = "no memory" if memory is None else f"a memory of shape {tuple(memory.shape)}"
            raise ValueError(f"this circuit has n_memory={n_memory} but was given {found}")
        if memory is None or not memory_weight:
            return self.biases
        return [
            th.addmm(bias, memory, weights.t(), alpha=memory_weight)
            for bias, weights in zip(self.biases, self.memory, strict=True)
        ]

    def feedback_matrix(self, layer: int, scale: float = 1.0, tied: bool = False) -> th.Tensor:
        """
        What carries the error of the layer that ``weights[layer]`` predicts back to its source, in the layout of W.

        :param layer: 1 for the first hidden layer; 0, the input, only where learned error synapses reach it
        :param scale: λ_e of tied error synapses
        :param tied: through the weights themselves, whatever the circuit uses
        :return: E^T, or λ_e W, (n_out, n_in)
        """
        if self.feedback and not tied:
            return self.feedback[layer - (len(self.weights) - len(self.feedback))]
        return self.weights[layer] if tied or scale == 1.0 else scale * self.weights[layer]


def affine(bias: th.Tensor, activations: th.Tensor, weights: th.Tensor) -> th.Tensor:
    """
    The prediction W φ(z) + b.

    :param bias: (n_out,) or (B, n_out); of an ensemble (M, 1, n_out)
    :param activations: (B, n_in); of an ensemble (M, B, n_in)
    :param weights: (n_out, n_in); of an ensemble (M, n_out, n_in)
    :return: (B, n_out); of an ensemble (M, B, n_out)
    """
    if weights.dim() == 2:
        return th.addmm(bias, activations, weights.t())
    return th.baddbmm(bias, activations, weights.mT)


def add_product(total: th.Tensor, a: th.Tensor, b: th.Tensor, sign: float = 1.0) -> th.Tensor:
    """Add ``sign`` a b to ``total``, in place; (n, m), (m, k) and (n, k), or a leading dimension of members."""
    if total.dim() == 2:
        return total.addmm_(a, b, alpha=sign)
    return total.baddbmm_(a, b, alpha=sign)
