"""Rates at which settling is stable: spectral norms by power iteration, and the limits that follow from them."""

import math
from functools import lru_cache

import torch as th

MAX_AUTO_RATE = 0.3  # activations with kinks chatter at larger rates (batch-mean energy rises by 0.1 %)
SAFETY = 0.05  # share of the stability limit that "auto" uses: how deep K = 10 settles; see docs/paper.md, difference 10


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


def error_dynamics_limit(forward_norms: list[float], feedback_norms: list[float]) -> float:
    """
    Largest stable rate when error neurons integrate feedback and states follow their predictions.

    With a clamped output the error neurons obey ``e <- e + β M e + const``. In the worst case (every layer's leading
    singular vectors aligned, every unit active) M is the small matrix built here from the spectral norms, and the iteration
    is stable for β below the minimum of ``-2 Re(λ) / |λ|^2`` over its eigenvalues λ.

    :param forward_norms: ||W||_2 of every layer above the first, first to last
    :param feedback_norms: ||E||_2 of the same layers
    :return: the limit
    """
    n_hidden = len(forward_norms)
    matrix = th.zeros(n_hidden, n_hidden, dtype=th.float64)
    for layer in range(n_hidden):
        matrix[layer, layer] -= 1.0
        if layer + 1 < n_hidden:
            matrix[layer, layer + 1] += feedback_norms[layer]
        matrix[-1, layer] -= feedback_norms[-1] * math.prod(forward_norms[layer:])
    eigenvalues = th.linalg.eigvals(matrix)
    limits = -2.0 * eigenvalues.real / eigenvalues.abs().square()
    return float(limits.min())


@lru_cache(maxsize=256)
def arrival_fractions(rates: tuple[float, ...], n_steps: int) -> tuple[float, ...]:
    """
    How much of a constant output error has arrived at every layer after ``n_steps`` steps, if nothing answered it.

    Error neurons that integrate what the layer below tells them, ``e_l <- e_l + β_l (e_{l+1} - e_l)``, pass an error on like a
    queue; with one rate β the fraction at distance d from the output is the chance that a Binomial(n_steps, β) reaches d.

    :param rates: β of every hidden layer, first to last
    :param n_steps: K
    :return: fractions in (0, 1], first hidden layer to output (whose fraction is 1)
    """
    arrived = [0.0] * len(rates) + [1.0]
    for _ in range(n_steps):
        for layer, rate in enumerate(rates):  # first to last: each reads what the next held a step ago
            arrived[layer] += rate * (arrived[layer + 1] - arrived[layer])
    return tuple(max(fraction, 1e-12) for fraction in arrived)


def settling_rates(dynamics: str, forward_norms: list[float], feedback_norms: list[float]) -> list[float]:
    """
    The rates β that ``settling_rate="auto"`` uses, one per hidden layer (first to last).

    ``dynamics="state"``: 1 / (1 + ||W|| ||E||) of the weights below the layer, the local curvature of the energy.
    ``dynamics="error"``: one rate, the share ``SAFETY`` of :func:`error_dynamics_limit`. Both at most ``MAX_AUTO_RATE``.
    """
    if dynamics == "state":
        return [min(MAX_AUTO_RATE, 1.0 / (1.0 + w * e)) for w, e in zip(forward_norms, feedback_norms, strict=True)]
    if not all(map(math.isfinite, (*forward_norms, *feedback_norms))):
        return [0.0] * len(forward_norms)  # the check of the weights names the circuit
    rate = min(MAX_AUTO_RATE, SAFETY * error_dynamics_limit(forward_norms, feedback_norms))
    return [rate] * len(forward_norms)
