"""`rig import` as its users meet it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rig.cli.commands.imports import channel_map, scale_map
from rig.core.errors import ConfigurationError

ROWS = "".join(f"{k / 1000:.3f};{k % 13 / 10:.1f};{k % 7 / 10:.1f}\n" for k in range(300))
EXPORT = "time (s);left, front [mV];right\n" + ROWS.replace(".", ",")


def left_behind(folder: Path) -> list[str]:
    """Files of runs, whole or begun."""
    return [
        p.name for p in folder.rglob("*") if {".h5", ".rigj", ".part", ".sha256"} & set(p.suffixes)
    ]


@pytest.mark.thorough
def test_an_import_can_be_verified_and_shown_like_any_run(rig: Any) -> None:
    (rig.folder / "finger $7$.csv").write_text(EXPORT)
    ended = rig.run(
        *("import", "finger $7$.csv", "--time", "1", "--sensor", "skin 9", "--json"),
        *(
            "--object",
            "glass",
            "--channels",
            "v_1=left, front [mV],v_2=3",
            "--scale",
            "v_1=1mV,v_2=-0.5mV",
        ),
    )
    assert ended.code == 0, ended.stderr
    reported = ended.object
    assert reported["imported"]
    assert reported["simulated"] is None
    assert reported["summary"]["samples"] == 300
    assert reported["summary"]["rate_Hz"] == 1000.0
    assert reported["summary"]["scale"] == {"v_1": 1e-3, "v_2": -0.5e-3}
    assert "v_1: column 2 (left, front [mV]), 0.001 V per unit" in ended.stderr
    assert "text (semicolon, decimal comma), 300 samples at 1000 Hz" in ended.stderr
    file = rig.only("*.h5")
    assert reported["file"] == str(file.relative_to(rig.folder))
    assert sorted(reported["figures"]) == [
        reported["file"].replace(".h5", s) for s in (".png", ".svg")
    ]

    verified = rig.run("verify", str(file))
    assert verified.code == 0
    assert verified.stdout.endswith(": sound (complete, 1 of 1 point)\n")
    file.with_suffix(".svg").unlink()
    shown = rig.run("show", str(file), "--figures", "--all")
    assert shown.code == 0, shown.stderr
    drawn = file.with_suffix(".svg").read_text("utf-8")
    assert "IMPORTED recording finger $7$.csv" in drawn
    assert "object: glass" in drawn
    lines = [line.strip() for line in shown.stdout.splitlines()]
    for line in (
        "title: IMPORTED recording finger $7$.csv",
        "imported: yes",
        "file_name: finger $7$.csv",
        "channels: v_1=left, front [mV],v_2=3",
        "scale: v_1=1mV,v_2=-0.5mV",
        "sensor: skin 9",
    ):
        assert line in lines, shown.stdout
    assert not any(line.startswith(("simulated", "start_time")) for line in lines)
    refused = rig.run("calibrate", "pvdf", str(file))
    assert refused.code == 2
    assert "is a run of import, not of a sweep" in refused.errors[0]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--time", "1"), "labelled mV"),
        (("--time", "1", "--rate", "2kHz", "--scale", "v_1=1mV"), "--rate is 2000 Hz and the"),
        (("--scale", "v_1=1mV"), "sampling rate unknown"),
        (
            ("--rate", "-1kHz", "--scale", "v_1=1mV"),
            "--rate is -1000 Hz: must be 1 to 1e+07 Hz; correct --rate",
        ),
        (("--rate", "1kN"), "--rate 1kN: 'kN' does not convert to Hz"),
        (("--rate", "0"), "--rate 0: must be a finite number in Hz, not 0"),
        (("--rate", "1kHz", "--scale", "F_n=1N"), "--scale F_n: no such channel in --channels"),
        (("--rate", "1kHz", "--scale", "v_1=nan"), "--scale v_1 nan: must be a finite number"),
        (("--time", "9", "--scale", "v_1=1mV"), "column 9: the file has 3"),
        (("--time", "1", "--delimiter", "tab"), "no rows of two numbers or more at its end (tab)"),
        (("--rate", "1kHz", "--start-time", "2026-11-22T10:00:00"), "offset from UTC"),
    ],
)
@pytest.mark.thorough
def test_an_error_is_reported_in_one_line_and_nothing_is_left(
    rig: Any, arguments: tuple[str, ...], reason: str
) -> None:
    (rig.folder / "a.csv").write_text(EXPORT)
    ended = rig.run("import", "a.csv", "--channels", "v_1=2,v_2=3", *arguments)
    assert ended.code == 2
    (error,) = ended.errors
    assert reason in error
    assert "Traceback" not in ended.stderr
    assert left_behind(rig.folder) == []


def test_a_folder_that_cannot_be_written_is_reported(rig: Any) -> None:
    (rig.folder / "a.csv").write_text(ROWS)
    (rig.folder / "taken").write_text("a file, not a folder")
    ended = rig.run(
        *("import", "a.csv", "--channels", "v_1=2,v_2=3", "--time", "1", "--results", "taken")
    )
    assert ended.code == 1
    assert "no run can be recorded here" in ended.errors[0]
    assert left_behind(rig.folder) == []


def test_channels_are_read_with_commas_and_signs_in_their_names() -> None:
    assert channel_map("v_1=2, v_2 = left, front=a ,F_t=4") == {
        "v_1": "2",
        "v_2": "left, front=a",
        "F_t": "4",
    }
    assert scale_map("v_1=-2mV,time=1ms") == {"v_1": pytest.approx(-2e-3), "time": 1e-3}
    assert scale_map("") == {}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("v_1=2", "v_2 missing"),
        ("", "is not NAME=VALUE"),
        ("v_1=,v_2=3", "'v_1=' is not NAME=VALUE"),
        ("v_d=1,v_1=2,v_2=3", "'v_d=1' is not NAME=VALUE, NAME one of v_1, v_2, F_n, F_t"),
        ("v_1=2,v_2=3,v_1=4", "v_1 appears twice"),
    ],
)
def test_a_map_that_makes_no_sense_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        channel_map(text)
