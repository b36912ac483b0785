"""Tables of Markdown files that no hand has typed: written from exports, between markers.

    <!-- table: examples/results/tables.yml NAME -->
    | ... |
    <!-- /table -->

The YAML file, named from the Markdown file's folder, says for each name what stands in the table:

    NAME:
      from: first                    # folder of an export, beside the YAML file, or several: [first, second]; or, by the
                                     # task: {SparseReacher-v5: second, others: first}
      rows: {ActPC: actpc, demonstrators: demonstrators}
      columns: {Hopper: SparseHopper-v5, Reacher: {task: SparseReacher-v5, score: "{success_rate:.2f}"}}
      score: "{dense_return:.0f} ({sparse_return:.0f})"
      cell: "{score}, {steps:,.0f}"

What a row or a column says is added to what the table says, the row last; a text alone is the variant of a row and the task
of a column. ``from``, ``task``, ``variant``, ``settings``, ``seed`` and ``planned_steps`` choose runs, ``cell`` says what is
written of them: columns of ``results.csv`` with a format, which give the mean over the seeds, or with ``each``, ``min``,
``max``, ``std``, ``interval`` (the mean's, of 95 %) or ``curve`` (every evaluation, seed by seed) before it, as in
``{dense_return:each .0f}``; ``{n}``, the number of seeds; ``{paper}``, what the paper gives for the algorithm; and
``{score}``, which stands for what ``score`` says. A cell without runs is empty; † marks one with runs from a source tree with
uncommitted changes. The variants ``demonstrators``, ``random`` and ``paper:ALGO`` are known everywhere.
"""

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_actpc.experiments.report.figures import reference_lines
from sb3_actpc.experiments.report.page import UNDEFINED, markdown, number
from sb3_actpc.experiments.report.references import measure_of, paper_results
from sb3_actpc.experiments.report.results import load_results
from sb3_actpc.experiments.report.statistics import mean_interval
from sb3_actpc.experiments.runs.presets import read_yaml
from sb3_actpc.utils.files import atomic_write

_MARKER = re.compile(r"(<!-- table: (\S+) (\S+) -->\n).*?(<!-- /table -->)", re.DOTALL)
_CHOOSING = ("task", "variant", "settings", "seed", "planned_steps")
_KEYS = {"from", "rows", "columns", "cell", "score", *_CHOOSING}


def write_tables(path: Path) -> bool:
    """Write the tables of a Markdown file anew, and say whether it has changed; ValueError when a marker is wrong."""
    text = path.read_text(encoding="utf-8")
    filled = fill_tables(text, path.parent)
    if filled != text:
        with atomic_write(path, "w") as file:
            file.write(filled)
    return filled != text


def fill_tables(text: str, folder: Path) -> str:
    """A Markdown text with its tables written anew; ``folder`` is its own. ValueError when a marker is not closed, or says
    something unknown, FileNotFoundError when the YAML file or an export is missing."""
    found = len(_MARKER.findall(text))
    if not found == text.count("<!-- table:") == text.count("<!-- /table -->"):
        raise ValueError(
            "tables are marked by '<!-- table: FILE.yml NAME -->' and '<!-- /table -->': "
            f"{text.count('<!-- table:')} begin, {text.count('<!-- /table -->')} end, {found} are whole"
        )

    def filled(match: re.Match[str]) -> str:
        try:
            specs = _mapping("tables", read_yaml((folder / match[2]).read_bytes(), match[2]))
            if match[3] not in specs:
                raise ValueError(f"not in {match[2]}: there are {', '.join(specs)}")
            return f"{match[1]}{_table(_mapping('a table', specs[match[3]]), (folder / match[2]).parent)}\n{match[4]}"
        except (ValueError, KeyError) as error:
            raise ValueError(f"table {match[3]}: {error}") from error

    return _MARKER.sub(filled, text)


class _OverSeeds:
    """Values of the seeds, which a format makes into one text; ``evaluations`` are those of the runs."""

    def __init__(self, values: pd.Series, evaluations: pd.DataFrame) -> None:
        self.values, self.evaluations = values.astype(float), evaluations

    def __format__(self, form: str) -> str:
        how, _, form = form.rpartition(" ")
        if how not in ("", "each", "min", "max", "std", "interval", "curve"):
            raise ValueError(f"unknown {how!r} in a format: each, min, max, std, interval, curve, or nothing for the mean")
        if how == "curve":
            column, of_run = self.evaluations[str(self.values.name)], self.evaluations["run"]
            curves = [column[of_run == run].tolist() for run in self.values.index]
            return "; ".join(", ".join(number(value, form) for value in curve) for curve in curves)
        if how == "interval":
            bounds = [number(float(bound), form) for bound in mean_interval(self.values.to_numpy())[1:]]
            return "" if UNDEFINED in bounds else "[{}, {}]".format(*bounds)
        values = self.values if how == "each" else [self.values.agg(how or "mean", skipna=False)]
        return ", ".join(number(value, form) for value in values)


def _table(spec: dict[str, Any], folder: Path) -> str:
    rows, columns = (_mapping(name, spec.pop(name)) for name in ("rows", "columns"))
    by_column = [column if isinstance(column, dict) else {"task": column} for column in columns.values()]
    by_row = {name: row if isinstance(row, dict) else {"variant": row} for name, row in rows.items()}
    cells = [[name, *(_cell({**spec, **column, **row}, folder) for column in by_column)] for name, row in by_row.items()]
    return markdown(pd.DataFrame(cells, columns=["", *columns]))


def _mapping(what: str, given: Any) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise ValueError(f"{what} must be a mapping, found {given!r}")
    return given


def _cell(spec: dict[str, Any], folder: Path) -> str:
    if unknown := sorted(set(spec) - _KEYS):
        raise ValueError(f"unknown {', '.join(unknown)}; known are {', '.join(sorted(_KEYS))}")
    for key in ("cell", "score"):
        if not isinstance(spec.get(key, ""), str):
            raise ValueError(f"{key}={spec[key]!r} must be a text: put it into quotes")
    source = spec["from"]
    if isinstance(source, dict):
        source = source.get(spec.get("task"), source.get("others", []))
        if not source:
            return ""
    folders = source if isinstance(source, list) else [source]
    exported = pd.concat(_runs(folder / name) for name in folders)
    runs = exported[exported["algorithm"].notna() | ~exported.duplicated()]  # exports share their references
    for key in [key for key in _CHOOSING if key in spec]:
        if spec[key] not in (known := exported[key].unique()):
            raise ValueError(f"no {key} {spec[key]!r} in {', '.join(folders)}: there are {', '.join(sorted(map(str, known)))}")
        runs = runs[runs[key] == spec[key]]
    if runs.empty:
        return ""
    if runs["seed"].duplicated().any():
        raise ValueError(
            f"several runs with one seed for {spec}: name settings ({', '.join(runs['settings'].unique())}) or one export"
        )
    evaluations = pd.concat(_results(folder / name).evaluations for name in folders)
    n_runs = runs["algorithm"].notna().groupby(runs["task"]).sum().replace(0, np.nan)
    fields: dict[str, Any] = {name: _OverSeeds(runs[name], evaluations) for name in map(str, runs.select_dtypes("number"))}
    fields["n"] = _OverSeeds(n_runs, evaluations)
    fields["score"] = spec.get("score", "").format(**fields)
    text = re.sub(rf"(\s*\(|, | x ){UNDEFINED}\)?", "", spec["cell"].format(**fields)).strip()  # what is not known is left out
    return "" if text == UNDEFINED else f"{text} †" if runs["dirty"].any() else text


_results = cache(load_results)


@cache
def _runs(folder: Path) -> pd.DataFrame:
    """The finished runs of an export, and a row for each of the references of its tasks."""
    results = _results(folder)
    papers, rows = {}, []
    for task in results.finished["task"].unique():
        measure = measure_of(task)
        lines = reference_lines(results, task)
        rows += [{"task": task, "variant": name.removesuffix(" actions"), measure: value} for name, value in lines.items()]
        for _, row in paper_results(task).iterrows():
            papers[task, row.algo] = row.score / 100 if row.is_success else row.score
            rows.append({"task": task, "variant": f"paper:{row.algo}", measure: papers[task, row.algo]})
    own = zip(results.finished["task"], results.finished["algorithm"], strict=True)
    runs = results.finished.assign(paper=[papers.get(one, np.nan) for one in own])
    return pd.concat([runs, pd.DataFrame(rows).assign(dirty=False, seed=0, settings="")])
