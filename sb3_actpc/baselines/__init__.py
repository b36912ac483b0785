"""The algorithms that ActPC is compared with, as Stable-Baselines3 algorithms on the same tasks and demonstrations."""

from importlib.util import find_spec
from typing import Any

from sb3_actpc.baselines.bc import BC, BCRNN
from sb3_actpc.baselines.her import HER
from sb3_actpc.baselines.ibrl import IBRL
from sb3_actpc.baselines.logo import LOGO
from sb3_actpc.baselines.offline_rl import BCQ, CQL
from sb3_actpc.baselines.td3 import DDPGDemo, TD3Demo
from sb3_actpc.utils.extras import import_extra

__all__ = ["BC", "BCQ", "BCRNN", "CQL", "HER", "IBRL", "LOGO", "DDPGDemo", "TD3Demo"]
if find_spec("jax") and find_spec("sbx"):
    __all__ += ["RLPD"]


def __getattr__(name: str) -> Any:
    if name != "RLPD":
        raise AttributeError(f"module 'sb3_actpc.baselines' has no attribute {name!r}")
    return import_extra("sb3_actpc.baselines.rlpd", "jax").RLPD
