"""The bench: ratios are taken round by round, to the first entry."""

from importlib.util import find_spec

import pytest

from sb3_actpc.cli import main
from sb3_actpc.experiments import timing
from sb3_actpc.experiments.timing import ratios


def test_ratios_are_medians_of_the_rounds_own() -> None:
    times = {"SB3 TD3": [1.0, 2.0, 4.0], "ActPC": [2.0, 2.0, 40.0]}  # ratios 2, 1, 10
    assert ratios(times) == {"SB3 TD3": 1.0, "ActPC": 2.0}


def test_updates_and_steps_of_training_are_compared(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timing, "N_FILLED", 300)
    monkeypatch.setattr(timing, "N_STEPS", 5)
    assert main(["bench", "--rounds", "1", "--threads", "1", "--training"]) == 0
    lines = capsys.readouterr().out.splitlines()
    base = "RLPD" if find_spec("sbx") else "SB3 TD3"
    kinds = {"update, batch 256": ("SB3 TD3", "ActPC, actpc_paper.yml")}
    kinds["step with 4 updates, batch 128"] = (base, "matrix products alone")
    for kind, (first, other) in kinds.items():
        named = [line.removeprefix(kind).split() for line in lines if line.startswith(kind)]
        found = {" ".join(words[:-1]): float(words[-1]) for words in named}
        assert found[first] == 1.0 and found["ActPC, actpc.yml"] > 0.0 and found[other] > 0.0


def test_numbers_below_one_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["bench", "--rounds", "0"])
    assert "--rounds: 0 must be at least 1" in capsys.readouterr().err
