"""Activation functions φ and the in-place multiplication by their derivatives, as settling needs them."""

from collections.abc import Callable
from dataclasses import dataclass

import torch as th

_LEAKY_SLOPE = 0.01


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


# Functions with names, so that a circuit can be pickled. z are latents, h = φ(z), f the signal that is damped.


def _pass(z: th.Tensor, out: th.Tensor) -> th.Tensor:
    return z


def _pass_undamped(f: th.Tensor, z: th.Tensor, h: th.Tensor) -> th.Tensor:
    return f


def _relu(z: th.Tensor, out: th.Tensor) -> th.Tensor:
    return th.clamp(z, min=0.0, out=out)


def _damp_relu(f: th.Tensor, z: th.Tensor, h: th.Tensor) -> th.Tensor:
    return th.ops.aten.threshold_backward.grad_input(f, z, 0.0, grad_input=f)


def _relu6(z: th.Tensor, out: th.Tensor) -> th.Tensor:
    return th.clamp(z, 0.0, 6.0, out=out)


def _damp_relu6(f: th.Tensor, z: th.Tensor, h: th.Tensor) -> th.Tensor:
    return th.ops.aten.hardtanh_backward.grad_input(f, z, 0.0, 6.0, grad_input=f)


def _leaky_relu(z: th.Tensor, out: th.Tensor) -> th.Tensor:
    return th.ops.aten.leaky_relu.out(z, _LEAKY_SLOPE, out=out)


def _damp_leaky_relu(f: th.Tensor, z: th.Tensor, h: th.Tensor) -> th.Tensor:
    return th.ops.aten.leaky_relu_backward.grad_input(f, z, _LEAKY_SLOPE, False, grad_input=f)


def _elu(z: th.Tensor, out: th.Tensor) -> th.Tensor:
    return th.ops.aten.elu.out(z, 1.0, 1.0, 1.0, out=out)


def _damp_elu(f: th.Tensor, z: th.Tensor, h: th.Tensor) -> th.Tensor:
    return th.ops.aten.elu_backward.grad_input(f, 1.0, 1.0, 1.0, False, z, grad_input=f)


def _tanh(z: th.Tensor, out: th.Tensor) -> th.Tensor:
    return th.tanh(z, out=out)


def _damp_tanh(f: th.Tensor, z: th.Tensor, h: th.Tensor) -> th.Tensor:
    return th.ops.aten.tanh_backward.grad_input(f, h, grad_input=f)


ACTIVATIONS: dict[str, Activation] = {
    "identity": Activation("identity", _pass, _pass_undamped),
    "relu": Activation("relu", _relu, _damp_relu),
    "relu6": Activation("relu6", _relu6, _damp_relu6),
    "leaky_relu": Activation("leaky_relu", _leaky_relu, _damp_leaky_relu),
    "elu": Activation("elu", _elu, _damp_elu),
    "tanh": Activation("tanh", _tanh, _damp_tanh),
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
