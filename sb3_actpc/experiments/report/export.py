"""A comparison in a few small files."""

import gzip
import json
from pathlib import Path
from typing import Any

from sb3_actpc.experiments.report.figures import draw_curves
from sb3_actpc.experiments.report.results import CURVES, SETTINGS, load_results, run_folders, write_runs
from sb3_actpc.experiments.runs.record import CONFIG, read_config
from sb3_actpc.experiments.runs.schema import content, content_id
from sb3_actpc.utils.files import atomic_write, folder_name


def export(folder: Path, target: Path) -> list[Path]:
    """Write what is worth keeping of a comparison into a few small files, from which tables and figures can be made again:
    ``results.csv`` has a row for each run, ``curves.csv.gz`` their evaluations, ``settings.json`` what the ids of settings
    stand for, ``curves_TASK.png`` the figure of each task. ValueError when ``target`` is ``folder``, FileNotFoundError
    when there are no runs, OSError when a file cannot be written."""
    if target.resolve() == folder.resolve():
        raise ValueError(f"{target} is the folder of the runs themselves: give another, they would not be read again")
    results = load_results(folder)
    kept_settings = folder / SETTINGS  # of an export, which has no folders of runs
    settings: dict[str, Any] = json.loads(kept_settings.read_text(encoding="utf-8")) if kept_settings.is_file() else {}
    for path in run_folders(folder):
        if not (path / CONFIG).is_file():  # it failed before it wrote it
            continue
        config = read_config(path)
        settings[content_id(config)] = content(config)
    curves = results.evaluations[["run", *results.evaluations.columns.drop("run")]]
    with atomic_write(target / CURVES) as binary, gzip.GzipFile("", "wb", fileobj=binary, mtime=0) as packed:
        packed.write(curves.to_csv(index=False, float_format="%.6g").encode())
    with atomic_write(target / SETTINGS, "w") as file:
        file.write("{\n" + ",\n".join(f'"{name}": {json.dumps(settings[name])}' for name in sorted(settings)) + "\n}\n")
    files = [write_runs(results, target), target / CURVES, target / SETTINGS]
    kept = load_results(target)
    for task in kept.finished["task"].unique():
        files.append(target / f"curves_{folder_name(task)}.png")
        draw_curves(kept, task, files[-1])
    return files
