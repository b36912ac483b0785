"""Rates at which settling is stable: spectral norms by power iteration, and the limits that follow from them."""

import torch as th

MAX_AUTO_RATE = 0.3  # activations with kinks chatter at larger rates (batch-mean energy rises by 0.1 %)


def largest_norm_(matrix: th.Tensor, vector: th.Tensor, n_iterations: int = 1) -> th.Tensor:
    """
    The largest singular value of a matrix, or of those of all members of an ensemble, by warm-started power iteration.

    :param matrix: (n_out, n_in) or (M, n_out, n_in)
    :param vector: (n_in,) or (M, n_in), the running estimates of right singular vectors; overwritten
    :return: the estimate, 0-d, never above the true value
    """
    norms = []
    for one, direction in [(matrix, vector)] if matrix.dim() == 2 else zip(matrix, vector, strict=True):
        for _ in range(n_iterations):
            th.mv(one.t(), one @ direction, out=direction)
            direction.div_(th.linalg.vector_norm(direction).clamp_min(1e-30))
        norms.append(th.linalg.vector_norm(one @ direction))
    return th.stack(norms).max()


def settling_rates(forward_norms: list[float], feedback_norms: list[float]) -> list[float]:
    """
    The rates β that ``settling_rate="auto"`` uses, one per hidden layer (first to last).

    1 / (1 + ||W|| ||E||) of the weights below the layer, the local curvature of the energy; at most ``MAX_AUTO_RATE``.
    """
    return [min(MAX_AUTO_RATE, 1.0 / (1.0 + w * e)) for w, e in zip(forward_norms, feedback_norms, strict=True)]
