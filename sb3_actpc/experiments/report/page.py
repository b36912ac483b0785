"""A report as a list of sections, written as Markdown and as one HTML file that needs nothing else."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from jinja2 import Environment, FileSystemLoader, select_autoescape
from markupsafe import Markup

from sb3_actpc.experiments.report.tables import markdown
from sb3_actpc.utils.files import atomic_write


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
