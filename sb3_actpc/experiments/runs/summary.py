"""What a run shows at its end: a table and a plot."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_actpc.experiments.runs.evaluation import says_one_return
from sb3_actpc.utils.files import atomic_write


def result_table(result: Mapping[str, Any]) -> str:
    """The result of ``train_run`` or ``evaluate_run`` as aligned text, a line per quantity."""
    dense, own = (f"{result[f'{kind}return']:.1f} ± {result[f'{kind}return_std']:.1f}" for kind in ("dense_", ""))
    rows = [("return", own)]
    if not says_one_return(result):
        rows = [
            ("dense return", dense),
            ("demonstrators' dense return", _number(result.get("demonstrators_return"), ".1f")),
            ("return", own),
        ]
    rows += [
        ("success rate", _number(result["success"], ".2f")),
        ("episode length", f"{result['episode_length']:.1f}"),
    ]
    if result.get("failed_after"):
        rows.append(("failed, farthest stage", ", ".join(f"{stage} {n}" for stage, n in result["failed_after"].items())))
    if "steps_per_second" in result:
        rows.append(("steps per second, warm start included", f"{result['steps_per_second']:.0f}"))
    title = f"{result['env']}, {result['algo']}, seed {result['seed']}: mean ± std of {result['eval_episodes']} episodes"
    width = max(len(name) for name, _ in rows)
    return "\n".join([title, "-" * len(title), *(f"{name:<{width}}  {value}" for name, value in rows)])


def plot_learning_curve(progress: Path, output: Path, title: str, demonstrators_return: float | None) -> None:
    """Draw the dense and the sparse return of a ``progress.csv`` against the environment steps, and the demonstrators' as a
    dashed line."""
    import pandas as pd
    from matplotlib.figure import Figure

    rows = pd.read_csv(progress)
    steps, dense, spread = (rows[name].to_numpy() for name in ("timesteps", "dense_return", "dense_return_std"))
    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    dense_axes, return_axes = figure.subplots(2, 1, sharex=True)
    dense_axes.plot(steps, dense, marker="o", label="policy")
    dense_axes.fill_between(steps, dense - spread, dense + spread, alpha=0.2)
    if demonstrators_return is not None:
        dense_axes.axhline(demonstrators_return, color="black", linestyle="--", label="demonstrators")
    dense_axes.legend()
    dense_axes.set(title=title, ylabel="dense return (mean ± std)")
    return_axes.plot(steps, rows["return"], marker="o", color="tab:orange")
    return_axes.set(xlabel="environment steps", ylabel="return (mean)")
    with atomic_write(output) as image:
        figure.savefig(image, format="png", dpi=120)


def _number(value: float | None, form: str) -> str:
    return "n/a" if value is None else format(value, form)
