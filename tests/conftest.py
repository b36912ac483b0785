"""Shared by all tests: the same random numbers in each, whatever ran before."""

import random

import numpy as np
import pytest
import torch as th

# the test processes run side by side; one torch thread each
th.set_num_threads(1)


@pytest.fixture(autouse=True)
def seed_everything() -> None:
    """Seed the global generators of python, numpy and torch."""
    random.seed(0)
    np.random.seed(0)
    th.manual_seed(0)
