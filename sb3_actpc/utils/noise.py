"""Exploration noise that is given as a number."""

import numpy as np
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise


class GaussianNoise(ActionNoise):
    """Independent Gaussian noise on every dimension of an action in [-1, 1].

    :param std: standard deviation
    :param shape: of an action
    """

    def __init__(self, std: float, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.std = std
        self.shape = shape

    def __call__(self) -> np.ndarray:
        """float32 of the action's shape, from NumPy's global generator as SB3's noises."""
        return np.random.normal(size=self.shape).astype(np.float32) * np.float32(self.std)

    def __repr__(self) -> str:
        return f"GaussianNoise(std={self.std:g})"


def as_action_noise(noise: ActionNoise | float | None, shape: tuple[int, ...]) -> ActionNoise | None:
    """SB3's noise as it is, Gaussian noise for a standard deviation; None for 0 and None. ValueError where SB3's is of another
    shape than an action."""
    if isinstance(noise, ActionNoise):
        base = getattr(noise, "base_noise", noise)  # of several environments
        if isinstance(base, (NormalActionNoise, OrnsteinUhlenbeckActionNoise)) and not fits(shape, base._mu, base._sigma):
            raise ValueError(
                f"action_noise={noise!r} does not fit an action of shape {shape}: give a number for each dimension"
            )
        return noise
    return GaussianNoise(noise, shape) if noise else None


def fits(shape: tuple[int, ...], *arrays: np.ndarray) -> bool:
    """Whether arrays, together, have a number for each entry of the shape."""
    try:
        found = np.broadcast_shapes(*map(np.shape, arrays))
        return found != () and np.broadcast_shapes(found, shape) == shape
    except ValueError:
        return False


def noise_with_state(noise: ActionNoise | None) -> ActionNoise | None:
    """The noise, if it changes by being drawn; None for that of a number (of several environments too), which is a setting."""
    return None if isinstance(getattr(noise, "base_noise", noise), GaussianNoise) else noise
