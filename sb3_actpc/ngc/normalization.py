"""Layer normalization of hidden latents: x = (z - mean) / std over the units of one layer, without learned scale or shift.

Mean, variance and the sums of the backward pass are taken over one layer, so the operation is local to it (divisive
normalization). With tied feedback the error that passes through it is, numerically, the one of autograd.
"""

from typing import NamedTuple

import torch as th

EPSILON = 1e-5  # added to the variance, as in torch.nn.LayerNorm
NORMALIZATIONS = ("none", "layer")


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
    """
    :param latents: z, (..., B, n)
    :return: z normalized over the last dimension, and its statistics
    """
    return Normalized(*th.native_layer_norm(latents, latents.shape[-1:], None, None, EPSILON))


def jacobian_product(signal: th.Tensor, latents: th.Tensor, normalized: Normalized) -> th.Tensor:
    """
    J s = (s - mean(s) - x mean(s x)) / std, with J the Jacobian of :func:`normalize`, which is symmetric.

    :param signal: s, (..., B, n)
    :param latents: z, (..., B, n)
    :param normalized: of ``latents``
    :return: (..., B, n)
    """
    shape = latents.shape[-1:]
    mask = [True, False, False]
    return th.ops.aten.native_layer_norm_backward(signal, latents, shape, normalized.mean, normalized.rstd, None, None, mask)[
        0
    ]
