"""Matrix products, by choice in bfloat16: about half the time where the processor multiplies such numbers."""

import torch as th

MATMUL_PRECISIONS = ("float32", "bfloat16")
NARROWEST = 64  # a product with a side below this one costs less than turning its numbers into bfloat16
TALL = 8  # rows of a sum of outer products for each of its columns, from which its transpose costs less, a third at best


def multiply(a: th.Tensor, b: th.Tensor, bfloat16: bool, out: th.Tensor | None = None) -> th.Tensor:
    """
    a b, in the type of ``a``.

    :param a: (n, m)
    :param b: (m, k)
    :param bfloat16: round what is multiplied, and the sums, to bfloat16 where no side is below ``NARROWEST``; the sums are
        taken in float32
    :param out: (n, k), overwritten
    :return: (n, k)
    """
    if not (bfloat16 and _is_wide(a, b)):
        return th.mm(a, b, out=out)
    result = th.mm(a.bfloat16(), b.bfloat16())
    return result.to(a.dtype) if out is None else out.copy_(result)


def add_product(total: th.Tensor, a: th.Tensor, b: th.Tensor, bfloat16: bool, sign: float = 1.0) -> th.Tensor:
    """``total`` + ``sign`` a b, in the place of ``total``, (n, k); for the others see :func:`multiply`."""
    if bfloat16 and _is_wide(a, b):
        return total.add_(multiply(a, b, bfloat16), alpha=sign)
    return total.addmm_(a, b, alpha=sign)


def sum_outer(left: th.Tensor, right: th.Tensor, bfloat16: bool) -> th.Tensor:
    """
    The sum of the outer products of their rows, contiguous.

    :param left: (B, n)
    :param right: (B, m)
    :param bfloat16: see :func:`multiply`
    :return: left^T right, (n, m)
    """
    if right.shape[1] < NARROWEST and TALL * right.shape[1] <= left.shape[1]:
        return th.mm(right.t(), left).t().contiguous()
    return multiply(left.t(), right, bfloat16)


def _is_wide(a: th.Tensor, b: th.Tensor) -> bool:
    return min(*a.shape, b.shape[1]) >= NARROWEST


def has_bfloat16() -> bool:
    """Whether this machine multiplies such numbers, and does not emulate it (where torch is too old to tell: no)."""
    names = "_is_avx512_bf16_supported", "_is_amx_tile_supported"
    on_gpu = th.cuda.is_available() and th.cuda.is_bf16_supported(including_emulation=False)
    return on_gpu or any(getattr(th.cpu, name, bool)() for name in names)


def check_matmul_precision(chosen: str) -> None:
    """:raises ValueError: for "bfloat16" on a processor that only emulates its products, which takes longer than float32"""
    if chosen != "float32" and not has_bfloat16():
        raise ValueError(
            f"matmul_precision={chosen!r} needs a processor with avx512_bf16 or AMX; found "
            f"{th.backends.cpu.get_cpu_capability()} with neither: leave it out, or use 'float32'"
        )
