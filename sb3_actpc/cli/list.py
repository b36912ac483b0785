"""``sb3-actpc list``: what there is to choose from."""

import argparse
from collections.abc import Iterator

KINDS = ("tasks", "algos", "variants", "presets", "demos")


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser("list", help="what there is: tasks, algorithms, variants, presets, demonstrations")
    about = "tasks (--env), algos (--algo), variants of these (compare --algos), presets, demos"
    parser.add_argument("kind", choices=KINDS, help=about)


def run(args: argparse.Namespace) -> int:
    """Print a line for each."""
    rows = list({"tasks": _tasks, "algos": _algos, "variants": _variants, "presets": _presets, "demos": _demos}[args.kind]())
    width = max(len(name) for name, _ in rows)
    for name, about in rows:
        print(f"{name:{width}}  {about}".rstrip())
    return 0


def _tasks() -> Iterator[tuple[str, str]]:
    from sb3_actpc import envs

    yield from dict.fromkeys(envs.SPARSE_MUJOCO_IDS, "a MuJoCo task with a sparse reward").items()
    yield from dict.fromkeys(envs.GOAL_MUJOCO_IDS, "the same with a goal in the observation, for hindsight").items()
    yield from dict.fromkeys(envs.ROBOSUITE_IDS, "an arm of robosuite (extra robosuite)").items()
    yield "any other Gymnasium id", "with --demonstrations FILE or none; MODULE:ID where a module registers it"


def _algos() -> Iterator[tuple[str, str]]:
    from sb3_actpc.experiments.runs.algorithms import ALGORITHMS, load_algorithm

    for name in ALGORITHMS:
        try:
            yield name, (load_algorithm(name).__doc__ or "").strip().partition("\n")[0]
        except ImportError as error:  # an extra that is not installed
            yield name, str(error)


def _variants() -> Iterator[tuple[str, str]]:
    from sb3_actpc.experiments.comparison import find_variant, variant_names

    for variant in map(find_variant, variant_names()):
        if variant.about:
            yield str(variant.name), f"{variant.algo}: {variant.about}"


def _presets() -> Iterator[tuple[str, str]]:
    from sb3_actpc.utils.preset_files import preset_names, preset_path

    for name in preset_names():
        yield name, str(preset_path(name))


def _demos() -> Iterator[tuple[str, str]]:
    from sb3_actpc.demonstrations import Demonstrations
    from sb3_actpc.demonstrations.dataset import DATA_FOLDER

    for path in sorted(DATA_FOLDER.glob("*.npz")):
        demonstrations = Demonstrations.load(path)
        yield demonstrations.env_id, f"{demonstrations.n_episodes} episodes in {path}"
