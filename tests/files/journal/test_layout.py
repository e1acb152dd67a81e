"""A column is declared once: key, name in files, unit, long name and meaning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import pytest
import recorded_run as run

from procedures.roll_trial.layout import LAYOUT as ROLL_TRIAL
from procedures.slip_trial.layout import LAYOUT as SLIP_TRIAL
from procedures.sweep.layout import LAYOUT as SWEEP
from rig.files.journal.layout import Column, Layout, Plot, unit_suffix
from rig.files.journal.values import RunHeader
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile


def test_the_short_form_derives_key_and_long_name() -> None:
    column = Column("creep", "um", "Travel of z during the hold")
    assert column.key == "creep_um"
    assert column.long_name == "Travel of z during the hold (um)"
    assert Column("trial", "", "Number of the trial").key == "trial"
    assert Column("coherence", "1", "Squared coherence").long_name == "Squared coherence"
    assert Column("overshoot", "%", "Overshoot").key == "overshoot_percent"
    assert Column("rate", "Hz", "Ticks of the servo", key="tick_Hz").key == "tick_Hz"


@pytest.mark.parametrize(
    ("units", "suffix"),
    [("N/mm", "N_mm"), ("mm/s^2", "mm_s2"), ("V s/N", "V_s_N"), ("%", "percent"), ("1", ""),
     ("dB/decade", "dB_decade"), ("V/sqrt(Hz)", "V_sqrtHz"), ("1/s", "S_s")],
)  # fmt: skip
def test_a_unit_as_the_end_of_a_key(units: str, suffix: str) -> None:
    assert unit_suffix(units) == suffix


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"name": "creep", "units": "um", "meaning": "x", "key": "creep_mm"}, "unit mm, but _um"),
        ({"name": "creep", "units": "um", "meaning": "x", "key": "creep"}, "no unit, but _um"),
        ({"name": "creep", "meaning": "x", "key": "creep_mm"}, "unit mm, but no unit"),
        ({"name": "creep of z", "units": "um", "meaning": "x"}, "letters, digits"),
        ({"name": "creep", "units": "um", "meaning": "x", "key": "a-um"}, "not a usable name"),
        ({"name": "creep", "units": "um"}, "no meaning and no long_name"),
        ({"name": "creep", "units": "um", "long_name": "Creep (um)"}, "no meaning and no key"),
        ({"name": "attempt", "meaning": "x"}, "that name already"),
        ({"name": "gain", "units": "gain_dB", "meaning": "dB", "kind": "Gain (dB)"}, "kind"),
    ],
)
def test_a_column_that_contradicts_itself_is_refused(
    arguments: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        Column(**arguments)


def test_a_layout_of_an_older_journal_reads_and_writes_back_to_the_same() -> None:
    older = {
        "definition": "NXrig_sweep",
        "version": "1.0",
        "columns": [
            {"name": name, "source": key, "units": "V", "long_name": name, "kind": "number"}
            for name, key in (("gain", "gain_V"), ("odd", "no unit!"))
        ],
        "plots": [
            {"group": "data", "signal": "gain", "axes": ["odd"], "errors": None, "auxiliary": [],
             "log_axes": [], "title": ""},
        ],
        "default": "data",
        "traces": [],
    }  # fmt: skip
    layout = Layout.from_json(older)
    assert [column.key for column in layout.columns] == ["gain_V", "no unit!"]
    assert layout.to_json() == older
    assert [list(column) for column in layout.to_json()["columns"]] == [
        ["name", "source", "units", "long_name", "kind"]
    ] * 2


@pytest.mark.parametrize("layout", [SWEEP, SLIP_TRIAL, ROLL_TRIAL])
def test_a_layout_survives_its_journal(layout: Layout) -> None:
    header = RunHeader.model_validate(run.header(layout=layout.to_json()))
    assert header.layout == layout
    assert RunHeader.model_validate_json(header.model_dump_json()).layout == layout


def test_the_meaning_is_in_the_run_file(tmp_path: Path) -> None:
    layout = Layout(
        "NXrig_sweep",
        "1.0",
        columns=(
            Column("frequency", "Hz", "Frequency"),
            Column("creep", "um", "Travel of z during the hold"),
            Column("remark", "", "What the operator saw", "text"),
        ),
        plots=(Plot("data", "creep", ("frequency",)),),
    )
    with JournalWriter.create(tmp_path / "a.rigj", run.header(layout=layout.to_json())) as journal:
        journal.point_begin("p", {})
        journal.point_keep("p", {"frequency_Hz": 10.0, "creep_um": 1.5, "remark": "quiet"})
        journal.end(run.end(points=1))
        journal.sync()
    file = compile_run(tmp_path / "a.rigj")
    with RunFile.open(file) as opened:
        assert opened.column("creep").tolist() == [1.5]
        assert opened.header.layout == layout
    with h5py.File(file) as opened:
        creep = opened["entry/points/creep"].attrs
        assert creep["description"] == "Travel of z during the hold"
        assert creep["long_name"] == "Travel of z during the hold (um)"
        assert creep["units"] == "um"
        assert opened["entry/points/remark"].attrs["description"] == "What the operator saw"
