"""Results in the journal and in the run file: one field a number, with error, unit and origin."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import recorded_run as run
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.cli.show.results import computed_by
from rig.files.definitions import definition_path
from rig.files.journal.reader import read_journal
from rig.files.journal.values import Program, Results
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile
from rig.files.runfile.result_fields import result_fields
from rig.files.verify import verify
from rig.run.results import Difference, differences

SLOPE = {"value": 20.01, "standard_error": 0.02, "low": 19.97, "high": 20.05, "unit": "dB/decade"}
DROPS = [
    {"frequency": {"value": f, "standard_error": 0.1, "low": f - 1, "high": None, "unit": "Hz"}}
    for f in (408.0, 2400.0)
]
VALUES = {
    "mean_static_friction": 0.68,
    "force_zero_N": [0.9, -0.5, 1.7],
    "analysis": ["a sentence", "µ"],
    "standard_errors": {"mean_static_friction": 0.01},
    "model": {
        "slope": SLOPE,
        "drops": DROPS,
        "verdict": {"answer": "holds", "reason": "why"},
        "by_frequency": {"gain_dB": [1.0, None, 3.0]},
        "bounds": {"slope_dB_decade": 0.05},
        "not_measured": None,
    },
}


def results(**changes: Any) -> dict[str, Any]:
    return {
        "program": {"name": "tactile-rig", "version": "0.9.1", "configuration": "abc"},
        "method": "least squares",
        "values": VALUES,
        "origins": {"model.bounds": "set"},
        "put_in": {"model.slope": 20.0, "model.drops.frequency": [408.2, math.nan]},
        "labels": {"force_zero_N": "force before taring"},
    } | changes


def recorded(path: Path, **changes: Any) -> Path:
    """A whole run with results."""
    journal = run.write_run(path)
    with JournalWriter.reopen(journal) as more:
        more.end(run.end())
        more.results(results(**changes))
        more.sync()
    return journal


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compile_run(recorded(tmp_path_factory.mktemp("results") / "a.rigj"))


def test_each_number_is_a_field_with_error_unit_and_origin(file: Path) -> None:
    with h5py.File(file) as opened:
        process = opened["entry/results"]
        assert process.attrs["NX_class"] == "NXprocess"
        assert process["program"][()] == b"tactile-rig"
        assert process["program"].attrs["configuration"] == "abc"
        assert process["version"][()] == b"0.9.1"
        assert process["method/data"][()] == b"least squares"
        slope = process["values/model/slope"]
        assert slope[()] == 20.01
        assert dict(slope.attrs) == {
            "units": "dB/decade",
            "origin": "recovered",
            "put_in_by_the_World": 20.0,
        }
        assert process["values/model/slope_errors"][()] == 0.02
        assert process["values/model/slope_errors"].attrs["units"] == "dB/decade"
        assert process["values/model/slope_low"][()] == 19.97
        friction = process["values/mean_static_friction"]
        assert dict(friction.attrs) == {"units": "1", "origin": "measured"}
        assert process["values/mean_static_friction_errors"][()] == 0.01
        assert process["values/model/verdict/answer"][()] == b"holds"
        assert process["values/model/bounds/slope_dB_decade"].attrs["origin"] == "set"
        assert process["values/force_zero_N"].attrs["description"] == "force before taring"
        assert process["values/force_zero_N"].attrs["units"] == "N"
        assert "not_measured" not in process["values/model"]
        assert "standard_errors" not in process["values"]


def test_a_list_of_tables_becomes_arrays_and_what_is_not_known_nan(file: Path) -> None:
    with h5py.File(file) as opened:
        model = opened["entry/results/values/model"]
        assert model["drops/frequency"][()].tolist() == [408.0, 2400.0]
        assert model["drops/frequency_errors"][()].tolist() == [0.1, 0.1]
        assert np.isnan(model["drops/frequency_high"][()]).all()
        put_in = model["drops/frequency"].attrs["put_in_by_the_World"]
        np.testing.assert_array_equal(put_in, [408.2, math.nan])
        np.testing.assert_array_equal(model["by_frequency/gain_dB"], [1.0, math.nan, 3.0])


def test_they_are_read_as_they_were_given_and_the_file_is_sound(file: Path) -> None:
    with RunFile.open(file) as opened:
        assert opened.results is not None
        assert opened.results.values == VALUES
        assert opened.results.program.version == "0.9.1"
    assert verify(file) == []


@pytest.mark.thorough
def test_nexusformat_reads_them_and_finds_nothing(file: Path) -> None:
    from nexusformat.nexus import nxload
    from nexusformat.nexus.validate import validate_application, validate_file

    assert validate_file(str(file)) == (0, 0)
    definition = str(definition_path("NXrig_sweep"))
    assert validate_application(str(file), application=definition) == (0, 0)
    entry = nxload(str(file))["entry"]
    assert entry["results"].nxclass == "NXprocess"
    assert entry["results/values/model/slope_errors"].nxdata == 0.02
    assert entry["results/values/model/slope"].units == "dB/decade"


def test_the_same_journal_gives_the_same_bytes(file: Path, tmp_path: Path) -> None:
    again = compile_run(file.with_suffix(".rigj"), tmp_path / file.name)
    assert again.read_bytes() == file.read_bytes()


def test_a_field_that_was_changed_is_found_by_its_journal(file: Path, tmp_path: Path) -> None:
    journal = recorded(tmp_path / "a.rigj")
    changed = compile_run(journal)
    changed.chmod(0o644)
    with h5py.File(changed, "r+") as opened:
        opened["entry/results/values/model/slope"][()] = 21.0
    assert any("results/values/model/slope differs" in found for found in verify(changed))


def test_a_version_that_is_not_that_of_the_layout_is_found(file: Path, tmp_path: Path) -> None:
    """Readers of later versions go by the layout; another program may go by the attribute."""
    changed = compile_run(recorded(tmp_path / "a.rigj"))
    changed.chmod(0o644)
    with h5py.File(changed, "r+") as opened:
        opened["entry/definition"].attrs["version"] = "99"
    assert "definition/@version is not that of the layout" in verify(changed)


def test_what_is_recorded_behind_results_makes_them_void(tmp_path: Path) -> None:
    with JournalWriter.create(tmp_path / "a.rigj", run.header()) as journal:
        run.take_point(journal, 0)
        journal.end(run.end("stopped", 1))
        journal.results(results())
    stopped = read_journal(tmp_path / "a.rigj")
    assert stopped.results is not None
    assert stopped.end is not None
    with RunFile.open(compile_run(tmp_path / "a.rigj")) as opened:
        assert opened.results is not None
        assert opened.outcome.status == "stopped"
    with JournalWriter.reopen(tmp_path / "a.rigj") as journal:
        run.take_point(journal, 1)
    resumed = read_journal(tmp_path / "a.rigj")
    assert (resumed.results, resumed.end) == (None, None)
    with RunFile.open(compile_run(tmp_path / "a.rigj")) as opened:
        assert opened.results is None


NAMES = st.text(max_size=4) | st.sampled_from(["a", "a_errors", "a_low", "a b", "a/b", "", "."])
LEAVES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=3)
    | st.just(SLOPE)
    | st.lists(st.none() | st.floats() | st.integers(), max_size=3)
    | st.lists(st.text(max_size=3), max_size=2)
)
SUMMARIES = st.dictionaries(
    NAMES, st.recursive(LEAVES, lambda inner: st.dictionaries(NAMES, inner, max_size=4)), max_size=5
)


@settings(max_examples=60, deadline=None)
@given(SUMMARIES)
def test_whatever_a_summary_holds_every_field_has_a_place_of_its_own(
    values: dict[str, Any],
) -> None:
    fields = list(result_fields(Results.model_validate(results(values=values))))
    paths = [field.path for field in fields]
    assert len(set(paths)) == len(paths)
    groups = {path[:depth] for path in paths for depth in range(1, len(path))}
    assert not groups & set(paths)


def test_results_that_no_field_can_hold_do_not_cost_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ValueError("no such thing")

    journal = recorded(tmp_path / "a.rigj")
    monkeypatch.setattr("rig.files.runfile.write_results.set_attributes", broken)
    file = compile_run(journal)
    with h5py.File(file) as opened:
        assert "values" not in opened["entry/results"]
        assert b"no such thing" in opened["entry/results/failure/data"][()]
    with RunFile.open(file) as opened:
        assert opened.results is not None
        assert opened.results.values == VALUES
        assert opened.outcome.points_done == 5


def test_what_two_versions_find_differently_is_named_and_nothing_else() -> None:
    now = {
        **VALUES,
        "mean_static_friction": 0.68 * (1 + 1e-9),
        "model": {**VALUES["model"], "slope": {**SLOPE, "value": 19.9}, "new": 3.0},
    }
    assert differences(VALUES, VALUES) == {}
    assert differences(VALUES, now) == {
        "model.slope": Difference(20.01, 19.9, "dB/decade"),
        "model.new": Difference(None, 3.0),
    }
    within = {**SLOPE, "value": 20.01 + 0.009 * SLOPE["standard_error"]}
    assert differences({"slope": SLOPE}, {"slope": within}) == {}


def test_other_words_for_the_same_are_no_other_values() -> None:
    program = Program(name="tactile-rig", version="0.9.1", configuration="abc")
    stored = Results(program=program, values={"analysis": ["slope 20.0"], "points": 5})
    now = stored.model_copy(update={"program": program.model_copy(update={"version": "0.9.2"})})
    for values, finds in (
        ({"analysis": ["slope 20.0"], "points": 5}, "the same"),
        ({"analysis": ["slope 20.00"], "points": 5}, "the same in other words"),
        ({"analysis": ["slope 20.00"], "points": 6}, "1 value otherwise"),
    ):
        said = computed_by(stored, now.model_copy(update={"values": values}))
        assert said.endswith(f"this is 0.9.2 (abc), which finds {finds}")


def test_show_says_beside_the_stored_value_what_this_version_finds(rig: Any) -> None:
    stored = {"points": 5, "largest_gain_standard_error_dB": 0.02, "model": {"slope": SLOPE}}
    file = compile_run(recorded(rig.folder / "a.rigj", values=stored))
    shown = rig.run("show", str(file))
    assert shown.code == 0, shown.stderr
    assert "results computed by: tactile-rig 0.9.1 (abc)" in shown.stdout
    reported = rig.run("show", "--json", str(file)).object
    assert reported["results"] == stored
    assert reported["results_by"]["version"] == "0.9.1"
    assert reported["results_method"] == "least squares"


def test_a_result_of_a_former_name_is_read_by_its_present_one(tmp_path: Path) -> None:
    def seen_above(name: str) -> dict[str, Any]:
        return {"model": {"circuit": {"separability": {"seen_above": {name: 221115.0}}}}}

    former = compile_run(recorded(tmp_path / "a.rigj", values=seen_above("R1+R2")))
    with RunFile.open(former) as opened:
        assert opened.results is not None
        assert opened.results.values == seen_above("R1+R2_ohm")
        assert differences(opened.results.values, seen_above("R1+R2_ohm")) == {}
    assert verify(former) == []
