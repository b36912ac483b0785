"""Matrix products of one circuit, or of all members of an ensemble at once."""

import torch as th

NARROW = 64  # columns below which ``sum_outer`` may compute the transposed product
TALL = 8  # rows per column from which the transposed product is faster, by a third at best


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
