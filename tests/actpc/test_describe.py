"""What ``learn`` says with ``verbose=1``."""

from tests.actpc.agents import make


def test_learn_says_once_what_the_reward_is_made_of(capsys):
    model = make(verbose=1, learning_starts=1000)
    for _ in range(3):
        model.learn(5, reset_num_timesteps=False)
    assert capsys.readouterr().out.count("x task") == 1
    model.reward_weights = {"task": 0.5}
    model.learn(5)
    assert "reward: 0.5 x task" in capsys.readouterr().out
    model.learn(5)
    assert "x task" not in capsys.readouterr().out


def test_a_quiet_agent_says_nothing(capsys):
    make(learning_starts=1000).learn(5)
    assert capsys.readouterr().out == ""
