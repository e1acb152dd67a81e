"""`rig batch plan` and `rig batch schema` as their users run them, and the documented example."""

from __future__ import annotations

import json
import re
import tomllib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from calibrated import write_record

from rig.batch.plan.read import parse_batch
from rig.batch.plan.schema import batch_schema

DOCUMENTED = Path(__file__).parents[3] / "docs" / "batch.md"
SWEEPS = """\
[batch]
name = "films"
results = "nights"
[defaults.sweep]
frequencies_Hz = "200 Hz, 1 kHz"
[[experiment]]
procedure = "sweep"
repeat = 2
[experiment.matrix]
load_N = [1, 2]
[[experiment]]
procedure = "sweep"
name = "reference"
every = 2
"""


def write(rig: Any, text: str) -> str:
    (rig.folder / "night.toml").write_text(text)
    return "night.toml"


@pytest.mark.thorough
def test_a_plan_lists_every_run_and_foretells_the_night(rig: Any) -> None:
    until = SWEEPS.replace('"nights"', '"nights"\nstop_by = 2099-01-01T07:00:00')
    ended = rig.run("batch", "plan", write(rig, until))
    assert "SIMULATED bench (to check the batch; seed " in ended.stderr
    assert ended.code == 0, ended.stderr
    assert (
        "stop_by 2099-01-01 07:00:00 local time: 7 of 7 runs will have ended by then"
        in ended.stderr
    )
    assert "warning" not in ended.stderr
    heading, *lines = ended.stdout.splitlines()
    assert heading.split() == [
        *("run", "begins", "(local)", "condition", "repeat", "duration", "varied")
    ]
    for word in ("begins", "condition"):
        place = heading.index(word)
        assert all(line[place - 1] == " " != line[place] for line in lines), word
    assert [line.split()[0] for line in lines] == ["1", "2", "3", "4", "5", "6", "7"]
    assert [line.split()[3] for line in lines] == [
        *("reference-001", "sweep-001", "sweep-002", "reference-001"),
        *("sweep-001", "sweep-002", "reference-001"),
    ]
    assert lines[2].endswith("load_N=2")
    assert re.search(
        r"films: 7 runs \(3 conditions\), about .* ± .*, from .* to .* local time", ended.stderr
    )
    assert "of run files" in ended.stderr
    assert not (rig.folder / "nights").exists(), "planning leaves nothing"
    assert not (rig.folder / "results").exists()


@pytest.mark.thorough
def test_a_plan_as_json_says_what_its_table_says(rig: Any) -> None:
    ended = rig.run("batch", "plan", write(rig, SWEEPS), "--json")
    assert ended.code == 0, ended.stderr
    plan = ended.object
    assert plan["conditions"]["sweep-002"]["varied"] == {"load_N": 2.0}
    assert len(plan["runs"]) == 7
    each = [plan["conditions"][run["condition"]]["duration_s"] for run in plan["runs"]]
    assert abs(sum(each) - plan["duration_s"]) < 1e-6
    took = datetime.fromisoformat(plan["ends"]) - datetime.fromisoformat(plan["begins"])
    assert abs(took.total_seconds() - plan["duration_s"]) <= 1.0
    assert 0 < plan["disk_B"] < plan["free_B"]


@pytest.mark.thorough
def test_what_a_limit_refuses_is_reported_with_its_line_and_exit_4(rig: Any) -> None:
    ended = rig.run("batch", "plan", write(rig, SWEEPS.replace("[1, 2]", "[1, 30, 19]")))
    assert ended.code == 4, ended.stderr
    assert len(ended.errors) == 2
    lift, press = ended.errors
    assert "night.toml:6: experiment 1: sweep-002: --load 30 N (peak) is not below 0.8" in lift
    assert "night.toml:6: experiment 1: sweep-003: point 200Hz-19N: force_sensor force 44" in press


def test_all_errors_of_a_file_come_at_once_with_exit_2_before_any_bench(rig: Any) -> None:
    broken = SWEEPS.replace("[1, 2]", '[0, "2 kg"]').replace("every = 2", "every = 0")
    ended = rig.run("batch", "plan", write(rig, broken), "--json")
    assert ended.code == 2
    assert [line.split(": ")[1] for line in ended.errors] == [
        f"night.toml:{k}" for k in (10, 10, 14)
    ]
    assert len(ended.object["errors"]) == 3
    assert "starting" not in ended.stderr


def test_a_bench_with_another_fixture_is_refused_before_anything_is_connected(rig: Any) -> None:
    (rig.folder / "bench.toml").write_text('name = "b"\n[fixture]\nmounted = "plate"\n')
    ended = rig.run("batch", "plan", write(rig, SWEEPS))
    assert ended.code == 2
    assert "sweep (run 2, 3, 5 and 1 more) needs the film-clamp" in ended.stderr
    assert "[[also_mounted]]" in ended.stderr
    assert "starting" not in ended.stderr


@pytest.mark.thorough
def test_a_record_that_no_run_could_use_is_refused_before_anything_is_connected(rig: Any) -> None:
    calibrated = """
name = "b"
[fixture]
mounted = "film-clamp"
[load_cell]
name = "cell 3"
sensitivity_V_N = 0.1
[daq]
driver = "keysight-u2300a"
resource = "USB0::0x0957::0x1518::TW1::INSTR"
channels = { load_cell = 101 }
[calibrations]
load_cell = "cell.json"
"""
    (rig.folder / "bench.toml").write_text(calibrated)
    missing = rig.run("batch", "plan", write(rig, SWEEPS))
    assert missing.code == 2
    assert "night.toml:1: cannot read the calibration record cell.json" in missing.stderr
    begun = datetime(2020, 1, 1, tzinfo=UTC)
    write_record(rig.folder / "cell.json", begun, "2021-01-01T00:00:00+00:00")
    expired = rig.run("batch", "plan", write(rig, SWEEPS))
    assert expired.code == 2
    assert "the calibration of 'cell 3' of 2020-01-01 expired on 2021-01-01" in expired.stderr
    allowed = SWEEPS.replace('"nights"', '"nights"\nallow_expired = true')
    ended = rig.run("batch", "plan", write(rig, allowed))
    assert "expired" not in ended.stderr
    assert "lacks what this procedure needs" in ended.stderr, "it went on to look at the rest"


def test_a_home_folder_that_only_a_shell_knows_is_refused(rig: Any) -> None:
    ended = rig.run("batch", "plan", write(rig, SWEEPS.replace('"nights"', '"~/nights"')))
    assert ended.code == 2
    assert "batch.results = '~/nights': ~ is not replaced by your home folder" in ended.stderr
    assert not (rig.folder / "~").exists()


def test_files_of_the_simulation_have_to_be_there(rig: Any) -> None:
    simulation = '[simulation]\n[[simulation.fault]]\nruns = [1]\nplan = "faults.toml"\n'
    ended = rig.run("batch", "plan", write(rig, SWEEPS + simulation))
    assert ended.code == 2
    assert "night.toml:18: simulation.fault.plan = 'faults.toml': there is no such" in ended.stderr


# --- the schema -------------------------------------------------------------------------------


def test_the_schema_knows_every_setting_of_every_procedure(rig: Any) -> None:
    ended = rig.run("batch", "schema")
    assert ended.code == 0, ended.stderr
    schema = json.loads(ended.stdout)
    assert schema == batch_schema()
    definitions = schema["$defs"]
    sweep = definitions["sweep.settings"]["properties"]
    assert sweep["load_N"]["anyOf"][0] == {"exclusiveMinimum": 0, "type": "number"}
    assert sweep["load_N"]["description"] == "Sinusoidal load, peak. [N]"
    slip = definitions["slip-trial.matrix"]["properties"]["speed_mm_s"]
    assert slip["items"]["anyOf"][1]["type"] == "string"
    procedures = ["path-trial", "roll-trial", "slip-trial", "sweep"]
    assert definitions["Experiment"]["properties"]["procedure"]["enum"] == procedures
    assert sorted(schema["properties"]["defaults"]["properties"]) == procedures


def test_every_reference_within_the_schema_leads_somewhere() -> None:
    text = json.dumps(batch_schema())
    definitions = batch_schema()["$defs"]
    found = re.findall(r'"\$ref": "#/\$defs/([^"]+)"', text)
    assert found
    assert set(found) <= set(definitions)


# --- the documentation ------------------------------------------------------------------------


def test_the_documented_example_expands_as_the_text_says() -> None:
    text = DOCUMENTED.read_text()
    (example,) = re.findall(r"```toml\n(.*?)```", text, re.S)
    batch, plan, _ = parse_batch(example, "night.toml")
    reported = re.search(r"(\d+) runs of (\d+) conditions", text)
    assert reported is not None
    assert (len(plan.runs), len(plan.conditions)) == (int(reported[1]), int(reported[2]))
    assert batch.batch.order == "blocked"
    known = set(tomllib.loads(example)["batch"])
    assert known <= {word.strip("`") for word in re.findall(r"`[a-z_]+`", text)}, (
        "each is explained"
    )


def test_a_notification_that_could_never_be_delivered_is_refused_with_its_line(rig: Any) -> None:
    text = SWEEPS.replace("[defaults", '[batch.notify]\ncommand = ["no-such-program"]\n[defaults')
    ended = rig.run("batch", "plan", write(rig, text))
    assert ended.code == 2
    assert "night.toml:4: notify.command: 'no-such-program' is not found" in ended.stderr
