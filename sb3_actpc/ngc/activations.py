"""Activation functions φ and the in-place multiplication by their derivatives, as settling needs them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch as th

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
        ``activations`` is φ(latents)
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
    "tanh": (lambda z, out: th.tanh(z, out=out), lambda f, z, h: aten.tanh_backward.grad_input(f, h, grad_input=f)),
}
ACTIVATIONS = {name: Activation(name, apply, damp) for name, (apply, damp) in _FUNCTIONS.items()}


def get_activation(name: str) -> Activation:
    """The activation of that name."""
    return ACTIVATIONS[name]
