"""
Settling by minimal residuals: where eq. 1 comes to rest, in two to four steps instead of hundreds.

Under a clamped output the error neurons follow the output's error by one ordered sweep, ``e_l = φ'(z_l) ⊙ (E_l e_{l+1})``, and
the states that ride on them answer at the output, which shrinks the error that drives the sweep. Only that answer couples the
layers: at rest ``d + A d = d_0``, with the output's error d, its value d_0 at projection, and A the sweep and its answer.
The one unknown is as large as the output, whatever the width, so that the generalised conjugate residual method (Eisenstat,
Elman & Schultz, 1983) needs few steps. Every sample takes steps of its own size; E need not be W^T.
"""

import torch as th

from sb3_actpc.ngc.dynamics import SettlingChain
from sb3_actpc.ngc.synapses import add_product


def settle_krylov(chain: SettlingChain, n_steps: int, tolerance: float) -> int:
    """
    Bring a chain with a clamped output from its projection to rest, to first order in how far its states move.

    Linear circuits are solved exactly in as many steps as they have outputs. Where φ bends, the resting state is that of the
    slopes at projection. A step costs the matrix products of one step of eq. 1.

    :param chain: started (:meth:`~sb3_actpc.ngc.dynamics.SettlingChain.start_settling`), its output clamped; changed in place
    :param n_steps: the most steps
    :param tolerance: stop when what is left of the output's equation is at most this share of the error at projection (RMS
        over the batch)
    :return: the steps taken
    """
    residual = chain.drive.clone()
    goal = tolerance * float(residual.norm())
    totals = [*chain.errors, *(th.zeros_like(error) for error in chain.errors)]
    done: list[tuple[th.Tensor, list[th.Tensor]]] = []
    for _ in range(n_steps):
        answered, layers = _respond(chain, residual)
        for earlier, earlier_layers in done:  # the answers of all directions are kept orthogonal, sample by sample
            share = _dot(answered, earlier) / _dot(earlier, earlier).clamp_min(1e-30)
            for mine, theirs in zip([answered, *layers], [earlier, *earlier_layers], strict=True):
                mine.addcmul_(share, theirs, value=-1.0)
        size = _dot(answered, residual) / _dot(answered, answered).clamp_min(1e-30)
        for total, layer in zip(totals, layers, strict=True):
            total.addcmul_(size, layer)
        residual.addcmul_(size, answered, value=-1.0)
        done.append((answered, layers))
        if float(residual.norm()) <= goal:
            break
    for latents, move in zip(chain.latents[1:], totals[chain.n_hidden :], strict=True):
        latents.add_(move)
    chain.activate()
    return len(done)


def _respond(chain: SettlingChain, drive: th.Tensor) -> tuple[th.Tensor, list[th.Tensor]]:
    """(I + A) ``drive``, (B, n_outputs), with the hidden layers' errors and, after them, the moves of their states."""
    weights = chain.synapses.weights
    n_hidden = chain.n_hidden
    errors = [drive] * (n_hidden + 1)
    for layer in range(n_hidden, 0, -1):
        errors[layer - 1] = chain.feedback(layer, errors[layer])
    moves: list[th.Tensor] = []
    for layer, error in enumerate(errors[:-1], start=1):
        move = error.clone()
        if layer > 1:
            add_product(move, chain.slope(layer - 1, moves[-1]), weights[layer - 1].mT)
        moves.append(move)
    answer = chain.slope(n_hidden, moves[-1]) @ weights[-1].mT
    for _ in range(2):  # g' once in the prediction, once in the error that reaches the synapses
        answer = chain.circuit.output_activation.damp(answer, chain.output_prediction, chain.output)
    return answer.add_(drive), [*errors[:-1], *moves]


def _dot(a: th.Tensor, b: th.Tensor) -> th.Tensor:
    return (a * b).sum(-1, keepdim=True)
