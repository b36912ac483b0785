"""Keywords of constructors that pass on what they do not know."""

from typing import Any

from stable_baselines3 import TD3

from sb3_actpc.baselines import HER
from sb3_actpc.utils.constructors import constructor_keywords


class Closed:
    def __init__(self, first: int, second: int = 2, _hidden: int = 3) -> None: ...


class Silent(Closed):
    """Has no constructor of its own."""


class Open(Silent):
    def __init__(self, third: int, **options: Any) -> None: ...


class Shut(Open):
    def __init__(self, fourth: int) -> None: ...


def test_keywords_are_collected_up_to_the_first_constructor_that_passes_nothing_on() -> None:
    assert constructor_keywords(Closed) == constructor_keywords(Silent) == ["first", "second"]
    assert constructor_keywords(Open) == ["third", "first", "second"]
    assert constructor_keywords(Shut) == ["fourth"]


def test_a_baseline_takes_what_the_algorithm_under_it_takes() -> None:
    own = {"prioritized", "q_filter", "demonstrations"}  # of HER, of the DDPG under it, of the TD3 under that
    assert {*own, *constructor_keywords(TD3)} <= set(constructor_keywords(HER))
    assert own.isdisjoint(constructor_keywords(TD3))
