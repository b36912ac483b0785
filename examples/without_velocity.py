"""The sparse HalfCheetah without its velocities: what one observation does not say, the working memory can.

Imported, it registers the task; run, it writes the shipped demonstrations without their velocities (working_memory.yml).
"""

import dataclasses
import sys

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TransformObservation

from sb3_actpc import shipped_demonstrations
from sb3_actpc.demonstrations import Demonstrations

TASK, NAME, N_POSITIONS = "SparseHalfCheetah-v5", "SparseHalfCheetahWithoutVelocity-v0", 8


def make(**kwargs: object) -> gym.Env:
    """The task, whose observations are the 8 positions of 17 values."""
    space = gym.spaces.Box(-np.inf, np.inf, (N_POSITIONS,), np.float64)
    return TransformObservation(gym.make(TASK, **kwargs), lambda observation: observation[:N_POSITIONS], space)


gym.register(NAME, entry_point=make)

if __name__ == "__main__":
    shown = Demonstrations.load(shipped_demonstrations(TASK))
    before, after = shown.observations[:, :N_POSITIONS], shown.next_observations[:, :N_POSITIONS]
    dataclasses.replace(shown, observations=before, next_observations=after, env_id=NAME).save(sys.argv[1])
