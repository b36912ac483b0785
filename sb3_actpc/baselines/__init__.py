"""The systems that ActPC is compared with, as Stable-Baselines3 algorithms on the same tasks and demonstrations."""

from sb3_actpc.baselines.bc import BC, BCRNN
from sb3_actpc.baselines.her import HER
from sb3_actpc.baselines.logo import LOGO
from sb3_actpc.baselines.offline.served import BCQ, CQL, HBC, IRIS
from sb3_actpc.baselines.rlpd import RLPD
from sb3_actpc.baselines.td3 import DDPGDemo, TD3Demo

__all__ = ["BC", "BCQ", "BCRNN", "CQL", "HBC", "HER", "IRIS", "LOGO", "RLPD", "DDPGDemo", "TD3Demo"]
