"""The bench: ratios are taken round by round, each to its own unit; the table is written from the files."""

import json

import pytest

from sb3_actpc.experiments.timing import ratios as ratios_of
from sb3_actpc.experiments.timing import table


def test_ratios_are_medians_of_the_rounds_own():
    times = {
        "SB3 TD3 train()": [1.0, 2.0, 4.0],
        "bare": [2.0, 2.0, 40.0],  # ratios 2, 1, 10
        "products": [0.5, 0.5, 0.5],
        "one settling": [1.0, 0.5, 3.0],  # ratios 2, 1, 6
    }
    ratios = ratios_of(times, {"SB3 TD3 train()": "TD3", "products": "the products"})
    assert ratios["bare"] == (2.0, "TD3") and ratios["one settling"] == (2.0, "the products")
    assert ratios["products"] == (1.0, "the products")


def test_the_table_has_a_column_for_each_file(tmp_path):
    files = []
    for threads, ratio in ((1, 0.9), (2, 0.75)):
        files.append(tmp_path / f"{threads}.json")
        ratios = {"bare": [ratio, "TD3"], **({"compiled": [0.5, "TD3"]} if threads == 1 else {})}
        size = {"batch_size": 4096} if threads == 2 else {}
        files[-1].write_text(json.dumps({"device": "cpu", "threads": threads, **size, "ratios": ratios}))
    assert table(files).splitlines() == [
        "| update, over its unit | cpu, 1 threads | cpu, 2 threads, batch 4096 |",
        "| --- | --- | --- |",
        "| bare / TD3 | 0.90 | 0.75 |",
        "| compiled / TD3 | 0.50 |  |",
    ]
    for text in ('{"a": 1}', "[1]", '{"ratios": [1]}', "no JSON", '{"device": "cpu", "threads": 1, "ratios": {"bare": 1}}'):
        (tmp_path / "other.json").write_text(text)
        with pytest.raises(ValueError, match=r"other\.json: not what `sb3-actpc bench --output` writes"):
            table([*files, tmp_path / "other.json"])
