"""A report as a list of sections, written as Markdown and as one HTML file that needs nothing else; cells and tables."""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from jinja2 import Environment, FileSystemLoader, select_autoescape
from markupsafe import Markup

from sb3_actpc.utils.files import atomic_write

UNDEFINED = "n/a"


def number(value: float, form: str) -> str:
    """A cell in a format such as ``".1f"``; NaN is an undefined one."""
    text = UNDEFINED if math.isnan(value) else format(value, form)
    return text.removeprefix("-") if not text.strip("-0.") else text  # no negative zero


def mean_and_deviation(values: np.ndarray, form: str) -> str:
    """Mean ± sample standard deviation of those of (n_seeds,) that are defined, and of how many (n of N) where not of all."""
    known = values[~np.isnan(values)]
    if not len(known):
        return UNDEFINED
    spread = f" ± {format(known.std(ddof=1), form)}" if len(known) > 1 else ""
    share = f" ({len(known)} of {len(values)})" if len(known) < len(values) else ""
    return f"{format(known.mean(), form)}{spread}{share}"


def interval(bounds: Sequence[float], form: str) -> str:
    """A cell of lower and upper bound; empty where they are NaN."""
    return "" if math.isnan(bounds[0]) else f"{format(bounds[0], form)} to {format(bounds[1], form)}"


def markdown(table: pd.DataFrame) -> str:
    """A table of texts in GitHub's Markdown; of columns with two levels, each is named ``first: second``."""
    names = [": ".join(filter(None, name)) if isinstance(name, tuple) else str(name) for name in table.columns]
    lines = [names, ["---"] * len(names), *table.astype(str).to_numpy().tolist()]
    return "\n".join("| " + " | ".join(text.replace("|", "\\|") for text in line) + " |" for line in lines)


@dataclass(frozen=True)
class Section:
    """What a report says about one thing, in this order; each part may be missing."""

    title: str = ""
    text: str = ""  # a plain paragraph
    table: pd.DataFrame | None = None  # of texts
    picture: str = ""  # name of a PNG file beside the report
    caption: str = ""  # what the picture shows
    level: int = 2  # of the heading, 1 for that of the report


def write_pages(sections: Sequence[Section], folder: Path) -> list[Path]:
    """Write ``report.md`` and ``report.html``; the latter has the pictures, which are in the same folder, inside."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=select_autoescape(["html.j2"]),
        trim_blocks=True,
    )
    environment.filters |= {
        "markdown": markdown,
        "html": _html,
        "base64": lambda name: base64.b64encode((folder / name).read_bytes()).decode(),
    }
    files = [folder / "report.md", folder / "report.html"]
    for path in files:
        with atomic_write(path, "w") as file:
            file.write(environment.get_template(f"{path.name}.j2").render(sections=sections))
    return files


def _html(table: pd.DataFrame) -> Markup:
    with pd.option_context("display.max_colwidth", None):  # pandas cuts longer texts
        return Markup(table.to_html(index=False, border=0))  # pandas escapes the texts
