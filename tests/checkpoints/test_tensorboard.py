"""A run that is gone on with goes on with its curves."""

from pathlib import Path

import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env

from sb3_actpc import ActPC
from sb3_actpc.checkpoints import CheckpointCallback, continue_learning, load_checkpoint
from sb3_actpc.utils.weights import load_weights, save_weights
from tests.actpc.envs import CountingEnv


def curve(folder: Path) -> list[int]:
    """Steps at which something was logged."""
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(folder)).Reload()
    return [event.step for event in events.Scalars("rollout/ep_rew_mean")]


@pytest.mark.parametrize("name", ["run", "of_mine"])
@pytest.mark.parametrize("algorithm", [ActPC, TD3])
def test_the_curve_goes_on(tmp_path: Path, algorithm: type[BaseAlgorithm], name: str) -> None:
    board, saver = tmp_path / "board", CheckpointCallback(tmp_path / "checkpoints")
    model = algorithm("MlpPolicy", make_vec_env(CountingEnv), policy_kwargs={"net_arch": [8]}, tensorboard_log=str(board))
    model.learn(60, [StopTrainingOnMaxEpisodes(4), saver], log_interval=1, tb_log_name=name)
    stopped = model.num_timesteps
    model.learn(10, log_interval=1, tb_log_name=name)  # another run, beside it
    restored = load_checkpoint(algorithm, tmp_path / "checkpoints", make_vec_env(CountingEnv))
    continue_learning(restored, saver, log_interval=1)
    assert [path.name for path in sorted(board.iterdir())] == [f"{name}_1", f"{name}_2"]
    steps = curve(board / f"{name}_1")
    assert min(steps) < stopped < max(steps) and len(steps) == len(set(steps))


def test_weights_for_others_hold_no_folder_of_ours(tmp_path: Path) -> None:
    keywords = {"policy_kwargs": {"net_arch": [8]}, "buffer_size": 99}
    model = ActPC("MlpPolicy", make_vec_env(CountingEnv), tensorboard_log=str(tmp_path), **keywords)
    path = save_weights(model, tmp_path / "weights")
    assert load_weights(ActPC, path, make_vec_env(CountingEnv)).tensorboard_log is None
