"""Settings of the documentation: ``pip install -e ".[docs]" && python -m sphinx -W docs docs/_build``."""

import sys
from pathlib import Path

from sphinx.application import Sphinx

from sb3_actpc import __version__

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(Path(__file__).parent))

import diagrams  # noqa: E402  (beside this file)

project = "sb3_actpc"
author = "The sb3_actpc developers"
copyright = author
version = release = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build", "jupyter_execute", ".jupyter_cache", "sb3_projects.rst"]
html_theme = "furo"
html_title = "sb3_actpc"
html_static_path = ["_static"]
html_css_files = ["narrow.css"]
html_theme_options = {"navigation_with_keys": True}

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
# a notebook is executed when it has changed since the last build; an error in a cell ends the build
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 1800  # seconds, of one cell
nb_execution_in_temp = True
nb_merge_streams = True
nb_render_markdown_format = "myst"  # with tables

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_preserve_defaults = True


def link_to_files(app: Sphinx, docname: str, source: list[str]) -> None:
    """Folders of the repository are named, not linked: a page cannot show them."""
    source[0] = source[0].replace("[`hyperparams/`](../hyperparams)", "`hyperparams/`")


def setup(app: Sphinx) -> None:
    """Draw the diagrams before the pages are read."""
    diagrams.draw_circuits(Path(app.srcdir) / "_static" / "circuits.svg")
    app.connect("source-read", link_to_files)
