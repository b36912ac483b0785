from sb3_actpc.utils.arguments import *  # noqa: F403
