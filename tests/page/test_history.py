"""The list of runs, and what a browser gets of one of them."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import recorded_run as run

from rig.files.journal.layout import Column
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run
from rig.page.history import RunIndex
from rig.page.server import _json


def test_a_run_whose_files_have_names_that_are_not_utf8_is_listed_and_handed_out(
    tmp_path: Path,
) -> None:
    journal = run.write_run(tmp_path / "2026-11-21T22-00-00_sweep_r001.rigj")
    compile_run(journal, retire=True)
    file = journal.with_suffix(".h5")
    renamed = file.rename(tmp_path / os.fsdecode(os.fsencode(file.stem) + b"-M\xfcller.h5"))
    picture = renamed.with_suffix(".png")
    picture.write_bytes(b"picture")
    index = RunIndex(tmp_path)
    index.update()
    (listed,) = json.loads(_json(index.rows()).body)["runs"]
    assert listed["name"].endswith(r"-M\xfcller.h5")
    detail = json.loads(_json(index.detail(listed["id"])).body)
    names = [file["name"] for file in detail["files"]]
    assert [index.file(listed["id"], name) for name in names] == [
        (renamed, "application/x-hdf5"),
        (picture, "image/png"),
    ]
    for name in (detail["name"], detail["summary"]["file"], *names):
        name.encode()  # a browser asks for it in UTF-8


def test_a_run_is_shown_with_its_results_as_rig_show_has_them(tmp_path: Path) -> None:
    journal = tmp_path / "2026-11-21T22-00-00_sweep_r001.rigj"
    values = {"trials": 2, "valid_trials": 0}
    with JournalWriter.create(journal, run.header()) as writer:
        run.take_point(writer, 0)
        writer.end(run.end(points=1))
        writer.results({"program": run.header()["program"], "values": values})
    compile_run(journal)
    index = RunIndex(tmp_path)
    index.update()
    (listed,) = index.rows()["runs"]
    detail = index.detail(listed["id"])
    assert detail is not None
    assert detail["summary"]["results"] == values


def test_the_list_says_how_many_points_are_valid_where_some_are_not(tmp_path: Path) -> None:
    reasons = {"sound": ("", ""), "doubtful": ("", "late ticks 3 % are above 1 %")}
    for name, said in reasons.items():
        column = Column("invalid", "", "Why it is invalid", "text")
        layout = replace(run.LAYOUT, columns=(*run.LAYOUT.columns, column))
        journal = tmp_path / f"{name}.rigj"
        with JournalWriter.create(journal, run.header(layout=layout.to_json())) as writer:
            for number, why in enumerate(said):
                writer.point_begin(run.POINTS[number], {"time": 1.0 * number, "moves": [0.1]})
                writer.point_keep(run.POINTS[number], {**run.reading(number), "invalid": why})
            writer.end(run.end(points=2))
        compile_run(journal, retire=True)
    index = RunIndex(tmp_path)
    index.update()
    shown = {row["name"]: row["points"].split(", ")[1:] for row in index.rows()["runs"]}
    assert shown == {"sound.h5": [], "doubtful.h5": ["1 valid"]}


def test_an_answer_with_a_path_that_is_not_utf8_or_a_number_that_is_not_finite_is_json() -> None:
    answer = _json({"problem": "M\udcfcller: damaged", "duration_s": float("nan")})
    assert json.loads(answer.body.decode("ascii"))["duration_s"] is None
