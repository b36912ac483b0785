"""Hebbian plasticity: the changes that a settled circuit asks of its synapses, and the bounds on them."""

from dataclasses import dataclass

import torch as th

MIRRORED_TOGETHER = 512  # source neurons
NARROW = 64  # columns below which ``sum_outer`` may compute the transposed product
TALL = 8  # rows per column from which the transposed product is faster, by a third at best
SYNAPTIC_SCALINGS = ("none", "soft_bound", "column_norm")


@dataclass
class HebbianChanges:
    """
    Changes *to be added* to the synapses of one circuit, in forward order (first layer first).

    Those of an ensemble have a leading dimension M of members; its biases are (M, 1, n_out).

    :param weights: ΔW, each (n_out, n_in)
    :param biases: Δb, each (n_out,)
    :param memory: ΔM, each (n_out, n_memory); empty without a working memory
    """

    weights: list[th.Tensor]
    biases: list[th.Tensor]
    memory: list[th.Tensor]

    def tensors(self) -> list[th.Tensor]:
        """All changes but the error synapses', which follow from the weights'."""
        return [*self.weights, *self.biases, *self.memory]

    def add_(self, other: "HebbianChanges") -> "HebbianChanges":
        """Add the ``other`` changes of the same circuit, in place."""
        th._foreach_add_(self.tensors(), other.tensors())
        return self

    def scale_(self, factor: float | th.Tensor) -> "HebbianChanges":
        """Multiply all changes by ``factor`` (a number or a 0-d tensor), in place."""
        th._foreach_mul_(self.tensors(), factor)
        return self


def hebbian_changes(
    errors: list[th.Tensor],
    activations: list[th.Tensor],
    memory: th.Tensor | None,
    memory_weight: float,
) -> HebbianChanges:
    """
    ΔW = e φ(z)^T, Δb = e, ΔM = α_m e m^T, each the mean over the batch (paper: eq. for ΔW and the appendix).

    :param errors: postsynaptic errors, each (B, n_out); the output layer's already multiplied by g'
    :param activations: presynaptic activity, each (B, n_in)
    :param memory: (B, n_memory) or None
    :param memory_weight: α_m
    :return: the changes to be added
    """
    inverse_batch = 1.0 / errors[0].shape[-2]
    scaled = th._foreach_mul(errors, inverse_batch)
    return HebbianChanges(
        weights=[sum_outer(error, activity) for error, activity in zip(scaled, activations, strict=True)],
        biases=[error.sum(-2, keepdim=error.dim() > 2) for error in scaled],
        memory=[] if memory is None else [memory_weight * (error.t() @ memory) for error in scaled],
    )


def sum_outer(left: th.Tensor, right: th.Tensor) -> th.Tensor:
    """
    The sum over the batch of outer products, contiguous.

    :param left: (B, n); of an ensemble (M, B, n)
    :param right: (B, m); of an ensemble (M, B, m)
    :return: left^T right, (n, m); of an ensemble (M, n, m)
    """
    if left.dim() == 2 and right.shape[1] < NARROW and TALL * right.shape[1] <= left.shape[1]:
        return th.mm(right.t(), left).t().contiguous()
    return th.matmul(left.mT, right)


def mirrored(weights: th.Tensor) -> th.Tensor:
    """
    Error synapses from the responses of ``weights`` to noise: the sum of (W ξ) ξ^T over orthonormal noise patterns ξ.

    Weight mirroring (Akrout et al., arXiv 1904.05391) with orthogonal noise. Independent noise leaves an error of 1 / sqrt(n)
    after n patterns per neuron, which layer normalization amplifies; orthonormal patterns leave rounding alone. At most
    ``MIRRORED_TOGETHER`` source neurons are active at a time.

    :param weights: W, (n_out, n_in)
    :return: E^T, (n_out, n_in)
    """
    parts = []
    for source in weights.split(MIRRORED_TOGETHER, dim=1):
        noise = th.linalg.qr(th.randn(source.shape[1], source.shape[1], dtype=weights.dtype, device=weights.device)).Q
        responses = noise @ source.t()
        parts.append(responses.t() @ noise)
    return th.cat(parts, dim=1)


def soft_bound_(new: th.Tensor, old: th.Tensor, bound: float) -> None:
    """
    Scale the step that led from ``old`` to ``new`` by M = (w_b - |W|) / w_b, so that no synapse passes ±w_b.

    (ago109/active-neural-generative-coding, ``src/model/ngc.py``, scales by w_b - |W|; divided by w_b here so that a small
    synapse takes the step the optimiser chose.) ``new`` and ``old`` are of one shape; ``new`` is overwritten.
    """
    step = new - old
    step.mul_((1.0 - old.abs() / bound).clamp_(0.0, 1.0))
    th.add(old, step, out=new).clamp_(-bound, bound)


def bound_columns_(weights: th.Tensor, bound: float) -> None:
    """Shrink, in place, every column of ``weights`` (n_out, n_in) whose Euclidean norm passes ``bound`` to that norm."""
    norms = th.linalg.vector_norm(weights, dim=-2, keepdim=True)
    weights.mul_(bound / norms.clamp_min(bound))
