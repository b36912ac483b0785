"""Activation functions φ and the in-place multiplication by their derivatives, as settling needs them."""

from collections.abc import Callable
from dataclasses import dataclass

import torch as th

_LEAKY_SLOPE = 0.01
_aten = th.ops.aten


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
    apply: Callable[[th.Tensor, th.Tensor], th.Tensor]
    damp: Callable[[th.Tensor, th.Tensor, th.Tensor], th.Tensor]


ACTIVATIONS: dict[str, Activation] = {
    activation.name: activation
    for activation in (
        Activation("identity", lambda z, out: z, lambda f, z, h: f),
        Activation(
            "relu",
            lambda z, out: th.clamp(z, min=0.0, out=out),
            lambda f, z, h: _aten.threshold_backward.grad_input(f, z, 0.0, grad_input=f),
        ),
        Activation(
            "relu6",
            lambda z, out: th.clamp(z, 0.0, 6.0, out=out),
            lambda f, z, h: _aten.hardtanh_backward.grad_input(f, z, 0.0, 6.0, grad_input=f),
        ),
        Activation(
            "leaky_relu",
            lambda z, out: _aten.leaky_relu.out(z, _LEAKY_SLOPE, out=out),
            lambda f, z, h: _aten.leaky_relu_backward.grad_input(f, z, _LEAKY_SLOPE, False, grad_input=f),
        ),
        Activation(
            "elu",
            lambda z, out: _aten.elu.out(z, 1.0, 1.0, 1.0, out=out),
            lambda f, z, h: _aten.elu_backward.grad_input(f, 1.0, 1.0, 1.0, False, z, grad_input=f),
        ),
        Activation(
            "tanh",
            lambda z, out: th.tanh(z, out=out),
            lambda f, z, h: _aten.tanh_backward.grad_input(f, h, grad_input=f),
        ),
    )
}


def get_activation(name: str) -> Activation:
    """
    :param name: one of the keys of ``ACTIVATIONS``
    :return: the activation of that name
    :raises ValueError: when there is none
    """
    if name not in ACTIVATIONS:
        raise ValueError(f"activation={name!r} is unknown; choose one of {sorted(ACTIVATIONS)}")
    return ACTIVATIONS[name]
