"""Rates at which settling is stable: spectral norms by power iteration, and the limits that follow from them."""

import torch as th

MAX_AUTO_RATE = 0.3  # activations with kinks chatter at larger rates (batch-mean energy rises by 0.1 %)


def power_iteration_(matrix: th.Tensor, vector: th.Tensor, n_iterations: int = 1) -> th.Tensor:
    """
    One or more steps of power iteration, warm-started, for the largest singular value of ``matrix``.

    :param matrix: (n_out, n_in)
    :param vector: (n_in,), the running estimate of the right singular vector; overwritten
    :return: the estimate of ||matrix||_2, 0-d, never above the true value
    """
    for _ in range(n_iterations):
        image = matrix @ vector
        th.mv(matrix.t(), image, out=vector)
        vector.div_(th.linalg.vector_norm(vector).clamp_min(1e-30))
    return th.linalg.vector_norm(matrix @ vector)


def largest_norm_(matrix: th.Tensor, vector: th.Tensor, n_iterations: int = 1) -> th.Tensor:
    """
    :func:`power_iteration_` of one matrix, or of every member of an ensemble.

    :param matrix: (n_out, n_in) or (M, n_out, n_in)
    :param vector: (n_in,) or (M, n_in); overwritten
    :return: the largest norm, 0-d
    """
    if matrix.dim() == 2:
        return power_iteration_(matrix, vector, n_iterations)
    return th.stack([power_iteration_(*member, n_iterations) for member in zip(matrix, vector, strict=True)]).max()


def settling_rates(forward_norms: list[float], feedback_norms: list[float]) -> list[float]:
    """
    The rates β that ``settling_rate="auto"`` uses, one per hidden layer (first to last).

    1 / (1 + ||W|| ||E||) of the weights below the layer, the local curvature of the energy; at most ``MAX_AUTO_RATE``.
    """
    return [min(MAX_AUTO_RATE, 1.0 / (1.0 + w * e)) for w, e in zip(forward_norms, feedback_norms, strict=True)]
