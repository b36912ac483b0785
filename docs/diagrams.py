"""The diagram of the four circuits, drawn by matplotlib as an SVG file."""

from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

ERROR, REWARD, PREDICTION = "#c0392b", "#27763d", "#2c3e50"
Point = tuple[float, float]


def _box(axes: Axes, center: Point, title: str, text: str, color: str) -> None:
    """A rounded box of fixed size with a bold title and two lines."""
    x, y = center
    axes.add_patch(FancyBboxPatch((x - 1.25, y - 0.5), 2.5, 1.0, boxstyle="round,pad=0.05", fc=color, ec=PREDICTION))
    axes.text(x, y + 0.2, title, ha="center", va="center", weight="bold", fontsize=11)
    axes.text(x, y - 0.2, text, ha="center", va="center", fontsize=8.5)


def _arrow(axes: Axes, start: Point, end: Point, color: str, label: str, at: Point, style: str = "-") -> None:
    """An arrow with its label at a place of its own."""
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=13, color=color, lw=1.4, linestyle=style))
    axes.text(*at, label, ha="center", va="center", color=color, fontsize=8.5)


def draw_circuits(path: Path) -> None:
    """Write the diagram to ``path``: what each circuit predicts, and how errors and rewards flow."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(9.2, 5.6), layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(-0.2, 11.6), ylim=(-0.2, 6.6))
    axes.axis("off")
    _box(axes, (2.2, 5.6), "actor", "observation → action", "#dbe9f6")
    _box(axes, (9.2, 5.6), "critic (ensemble)", "observation, action → return", "#dbe9f6")
    _box(axes, (2.2, 3.2), "demonstrations", "and own good episodes", "#f3f3f3")
    _box(axes, (9.2, 3.2), "reward", "task + epistemic + instrumental", "#e4f3e4")
    _box(axes, (3.6, 0.8), "prior", "observation → next one", "#fbeedc")
    _box(axes, (7.8, 0.8), "generator", "observation, action → next one", "#fbeedc")
    _arrow(axes, (3.55, 5.85), (7.85, 5.85), PREDICTION, "action", (5.7, 6.05))
    _arrow(axes, (7.85, 5.35), (3.55, 5.35), ERROR, "error of the action (critic term)", (5.7, 5.12), "--")
    _arrow(axes, (2.2, 3.8), (2.2, 5.0), ERROR, "error (imitation term)", (3.5, 4.4), "--")
    _arrow(axes, (9.2, 3.8), (9.2, 5.0), REWARD, "target", (9.75, 4.4))
    _arrow(axes, (8.3, 1.4), (8.9, 2.6), REWARD, "epistemic: its error", (10.0, 2.0))
    _arrow(axes, (4.95, 1.3), (7.85, 2.9), REWARD, "instrumental: minus its error", (5.2, 2.45))
    _arrow(axes, (2.4, 2.6), (3.3, 1.4), PREDICTION, "trained on them, then frozen", (1.35, 1.95))
    figure_metadata = {"Date": None, "Creator": None}
    with matplotlib.rc_context({"svg.fonttype": "path", "svg.hashsalt": "circuits"}):
        figure.savefig(path, format="svg", metadata=figure_metadata)
