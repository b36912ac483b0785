"""
Activation functions φ and the in-place multiplication by their derivatives, as settling needs them, and layer normalization.

Layer normalization acts on hidden latents: x = (z - mean) / std over the units of one layer, without learned scale or shift.
Mean, variance and the sums of the backward pass are taken over one layer, so the operation is local to it (divisive
normalization). With tied feedback the error that passes through it is, numerically, the one of autograd.

"clamp" is for outputs alone: the prediction z, cut to [-1, 1]. Errors pass unchanged, except that one is dropped where z is
beyond a bound and the error points further out. So the cost is 1/2 (target - z)^2 within the bounds and rises linearly beyond
them; beyond a bound it is zero where the target is that bound. A critic moves an action up to the bound and no further
(projected gradient).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch as th

EPSILON = 1e-5  # added to the variance, as in torch.nn.LayerNorm
NORMALIZATIONS = ("none", "layer")
aten = th.ops.aten
Function = Callable[[th.Tensor, th.Tensor], th.Tensor]
Derivative = Callable[[th.Tensor, th.Tensor, th.Tensor], th.Tensor]


@dataclass(frozen=True)
class Activation:
    """
    A function φ applied unit by unit, written for the settling loop: nothing is allocated, one kernel per call.

    :param name: the name it is chosen by
    :param apply: ``apply(latents, out)`` writes φ(latents) into ``out`` and returns it (the identity returns ``latents``)
    :param damp: ``damp(signal, latents, activations)`` multiplies ``signal`` in place by φ'(latents), where
        ``activations`` is φ(latents); of "clamp" as above
    """

    name: str
    apply: Function
    damp: Derivative

    def __reduce__(self) -> tuple[Any, ...]:
        return get_activation, (self.name,)  # functions without a name cannot be pickled


# z are latents, h = φ(z), f the signal that is damped
_FUNCTIONS: dict[str, tuple[Function, Derivative]] = {
    "identity": (lambda z, out: z, lambda f, z, h: f),
    "relu": (
        lambda z, out: th.clamp(z, min=0.0, out=out),
        lambda f, z, h: aten.threshold_backward.grad_input(f, z, 0.0, grad_input=f),
    ),
    "relu6": (
        lambda z, out: th.clamp(z, 0.0, 6.0, out=out),
        lambda f, z, h: aten.hardtanh_backward.grad_input(f, z, 0.0, 6.0, grad_input=f),
    ),
    "leaky_relu": (
        lambda z, out: aten.leaky_relu.out(z, 0.01, out=out),
        lambda f, z, h: aten.leaky_relu_backward.grad_input(f, z, 0.01, False, grad_input=f),
    ),
    "elu": (
        lambda z, out: aten.elu.out(z, 1.0, 1.0, 1.0, out=out),
        lambda f, z, h: aten.elu_backward.grad_input(f, 1.0, 1.0, 1.0, False, z, grad_input=f),
    ),
    "clamp": (
        lambda z, out: th.clamp(z, -1.0, 1.0, out=out),
        lambda f, z, h: f.masked_fill_((z - h) * f > 0.0, 0.0),
    ),
    "tanh": (lambda z, out: th.tanh(z, out=out), lambda f, z, h: aten.tanh_backward.grad_input(f, h, grad_input=f)),
}
ACTIVATIONS = {name: Activation(name, apply, damp) for name, (apply, damp) in _FUNCTIONS.items()}
HIDDEN_ACTIVATIONS = [name for name in ACTIVATIONS if name != "clamp"]


def get_activation(name: str) -> Activation:
    """The activation of that name."""
    return ACTIVATIONS[name]


class Normalized(NamedTuple):
    """
    Normalized latents with the statistics that the backward pass needs.

    :param values: x, (..., B, n)
    :param mean: of every row, (..., B, 1)
    :param rstd: 1 / std of every row, (..., B, 1)
    """

    values: th.Tensor
    mean: th.Tensor
    rstd: th.Tensor


def normalize(latents: th.Tensor) -> Normalized:
    """Latents z, (..., B, n), normalized over the last dimension, and their statistics."""
    return Normalized(*th.native_layer_norm(latents, latents.shape[-1:], None, None, EPSILON))


def jacobian_product(signal: th.Tensor, latents: th.Tensor, normalized: Normalized) -> th.Tensor:
    """
    J s = (s - mean(s) - x mean(s x)) / std, with J the Jacobian of :func:`normalize`, which is symmetric.

    :param signal: s, (..., B, n)
    :param latents: z, (..., B, n)
    :param normalized: of ``latents``
    :return: (..., B, n)
    """
    _, mean, rstd = normalized
    mask = [True, False, False]
    return aten.native_layer_norm_backward(signal, latents, latents.shape[-1:], mean, rstd, None, None, mask)[0]
