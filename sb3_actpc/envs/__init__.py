"""Sparse-reward tasks, registered with Gymnasium when this package is imported.

Importing this package is light: MuJoCo and the environment classes are loaded by ``gymnasium.make``.
"""

from gymnasium.envs.registration import register, registry

from sb3_actpc.envs.robosuite_layouts import ROBOSUITE_TASKS

_TASKS = ("Reacher", "HalfCheetah", "Walker2d", "Hopper", "Swimmer")
SPARSE_MUJOCO_IDS: tuple[str, ...] = tuple(f"Sparse{task}-{version}" for version in ("v5", "v4") for task in _TASKS)
GOAL_MUJOCO_IDS: tuple[str, ...] = tuple(env_id.replace("Sparse", "Goal", 1) for env_id in SPARSE_MUJOCO_IDS)
ROBOSUITE_IDS: tuple[str, ...] = tuple(ROBOSUITE_TASKS)
SPARSE_IDS: tuple[str, ...] = SPARSE_MUJOCO_IDS + ROBOSUITE_IDS

UNSEEN_SEED = 2_000_000  # starts episodes that no training, evaluation or demonstrator has seen


def register_envs() -> None:
    """Register the sparse tasks with Gymnasium; ids that are registered already are left alone.

    The time limits of the MuJoCo tasks are those of the base tasks: 50 steps for the Reacher, 1000 for the others. The
    robosuite tasks have their own keyword ``horizon``.
    """
    for env_id in (*SPARSE_MUJOCO_IDS, *GOAL_MUJOCO_IDS):
        if env_id in registry:
            continue
        task, env_version = sparse_env_id(env_id).split("-")
        limit = 50 if task == "SparseReacher" else 1000
        kind = f"{task}{env_version.upper()}Env"
        if env_id in SPARSE_MUJOCO_IDS:
            register(env_id, f"sb3_actpc.envs.sparse_mujoco:{kind}", max_episode_steps=limit)
        else:
            register(env_id, "sb3_actpc.envs.goal_mujoco:make_goal_env", max_episode_steps=limit, kwargs={"task": kind})
    for env_id in ROBOSUITE_IDS:
        if env_id not in registry:
            register(env_id, f"sb3_actpc.envs.robosuite_tasks:{env_id.split('-')[0]}Env")


def sparse_env_id(env_id: str) -> str:
    """Id of the sparse task behind a goal task: ``SparseHopper-v5`` of ``GoalHopper-v5``, with a module where it had one;
    another id is returned as it is."""
    module, colon, name = env_id.rpartition(":")
    return f"{module}{colon}{name.replace('Goal', 'Sparse', 1)}" if name in GOAL_MUJOCO_IDS else env_id


def dense_env_id(env_id: str) -> str:
    """Id of the dense base task of a sparse MuJoCo task: ``Hopper-v5`` of ``SparseHopper-v5``; ValueError for another id."""
    if env_id not in SPARSE_MUJOCO_IDS:
        raise ValueError(f"env_id={env_id!r} is not a sparse MuJoCo task: choose one of {', '.join(SPARSE_MUJOCO_IDS)}")
    return env_id.removeprefix("Sparse")
