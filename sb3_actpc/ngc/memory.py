"""Working memory: a short history of randomly projected observations that biases every layer of a circuit."""

import torch as th
from torch import nn


class WorkingMemory(nn.Module):
    """
    m_t = [Q o_{t-H}, ..., Q o_{t-1}]: the ``history`` observations *before* o_t in its episode, each through one fixed
    Gaussian projection Q, concatenated (paper, section on the NGC circuit; H = 7 after Miller's span of memory).

    :param n_inputs: size of one observation
    :param history: H, number of observations in the memory
    """

    def __init__(self, n_inputs: int, history: int = 7) -> None:
        super().__init__()
        self.n_inputs = n_inputs
        self.history = history
        std = n_inputs**-0.5  # σ_q, which keeps the scale of the observations
        self.projection = nn.Parameter(th.randn(n_inputs, n_inputs) * std, requires_grad=False)

    @property
    def size(self) -> int:
        """Size of m_t: ``n_inputs * history``."""
        return self.n_inputs * self.history

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: (B, history, n_inputs), oldest first; rows before the episode's start are zero
        :return: m_t, (B, history * n_inputs)
        """
        return (observations @ self.projection.t()).flatten(1)
