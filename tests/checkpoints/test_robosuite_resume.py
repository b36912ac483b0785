"""Robosuite runs that are stopped in the middle of an episode."""

from pathlib import Path

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

from sb3_actpc import ActPC
from sb3_actpc.envs import ROBOSUITE_IDS
from tests.checkpoints.runs import ACTPC, SHORT_WARM_UP, assert_same, learn_in_two, learn_straight
from tests.demonstrations.made_up import made_up

pytest.importorskip("robosuite", reason="robosuite is an extra")

SETTINGS = {**ACTPC, **SHORT_WARM_UP, "gradient_steps": -1}


@pytest.mark.parametrize("env_id", ROBOSUITE_IDS)
def test_a_run_stopped_within_an_episode_is_the_run_never_stopped(env_id: str, tmp_path: Path) -> None:
    """Episodes of 20 steps, stopped after 33: the arm is on its way, and the next episodes must begin as they would have."""

    def make() -> ActPC:
        env = make_vec_env(env_id, seed=5, env_kwargs={"horizon": 20})
        return ActPC("MlpPolicy", env, demonstrations=made_up(env_id), **SETTINGS)

    straight = learn_straight(make, tmp_path / "straight", 65)
    resumed = learn_in_two(make, tmp_path / "resumed", 65, stop_at=33)
    assert_same(straight, resumed)
    one, other = (model.get_env().envs[0].unwrapped for model in (straight, resumed))  # type: ignore[union-attr]
    np.testing.assert_array_equal(one.data.qpos, other.data.qpos)
    np.testing.assert_array_equal(one.model.geom_size, other.model.geom_size)
    for model in (straight, resumed):
        model.get_env().close()  # type: ignore[union-attr]
