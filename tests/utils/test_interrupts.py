"""Ctrl-C in a terminal, which reaches the processes of the environments too: learning goes on afterwards."""

import os
import signal
import subprocess
import sys

import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_actpc import ActPC
from sb3_actpc.checkpoints import CheckpointCallback
from tests.utils.one_array import OneArray, agent, assert_no_transition_is_wrong


class PressesCtrlC(BaseCallback):
    """As a terminal does: every process of the group gets the signal."""

    def _on_step(self) -> bool:
        if self.n_calls == 20:
            os.killpg(os.getpgid(0), signal.SIGINT)
        return True


def learn_twice(kind: type, is_wrapped: bool, folder: str) -> None:
    """The script of the process."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell in the background ignores it
    env = kind([lambda: Monitor(OneArray()) if is_wrapped else OneArray()] * 2)
    model = agent(ActPC, env)
    callbacks = [PressesCtrlC(), *([CheckpointCallback(folder, save_freq=1000)] if folder else [])]
    try:
        model.learn(400, callbacks)
    except (KeyboardInterrupt, SystemExit) as stop:
        print("stopped by", type(stop).__name__)
    model.learn(40, reset_num_timesteps=False)
    if is_wrapped:  # an environment in another process is hooked through a wrapper
        assert_no_transition_is_wrong(model)
    env.close()
    print("went on")


@pytest.mark.parametrize(
    ("kind", "is_wrapped", "saves"),
    [
        (DummyVecEnv, True, False),
        (DummyVecEnv, True, True),
        (SubprocVecEnv, True, False),
        (SubprocVecEnv, True, True),
        (SubprocVecEnv, False, False),
    ],
)
def test_learning_goes_on_after_ctrl_c_in_a_terminal(kind, is_wrapped, saves, tmp_path):
    folder = str(tmp_path / "checkpoints") if saves else ""
    script = f"from tests.utils.test_interrupts import *\nlearn_twice({kind.__name__}, {is_wrapped}, {folder!r})"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, start_new_session=True, timeout=300)
    stop = "TrainingStopped" if saves else "KeyboardInterrupt"
    assert done.stdout.splitlines()[:2] == [f"stopped by {stop}", "went on"], done
    assert not saves or list((tmp_path / "checkpoints").iterdir())
