"""The streams of a roll trial, the columns of its readings, and how the run file shows both."""

from __future__ import annotations

from procedures.pressed.record import layout as pressed_layout
from procedures.pressed.record.layout import ASKED, CALIBRATED, HELD, RECORDED, TOUCHED, ages
from rig.files.journal.layout import Column, Layout, Plot, Trace
from rig.run.procedure import StreamPlan

STREAMS = (
    *(stream for stream in pressed_layout.STREAMS if stream.name != "ages"),
    StreamPlan(
        "rotation",
        "rotary",
        ("angle", "angle_commanded"),
        "Angle of the object from upright, measured and commanded, at the ticks",
        "<f8",
        "deg",
        times="ticks",
    ),
    ages("z", "x", "angle"),
)

LAYOUT = Layout(
    definition="NXrig_roll_trial",
    version="2",
    columns=(
        *ASKED,
        Column("start_on_skin", "mm", "Start of the roll on the skin"),
        Column("angle", "deg", "Largest angle from upright"),
        Column("angle_error", "deg", "Error of the angle at rest"),
        Column("angle_lag", "deg", "Largest error of the angle underway"),
        *HELD,
        Column("peak_1", "mV", "Largest excursion of v_1 on the way there"),
        Column("peak_2", "mV", "Largest excursion of v_2 on the way there"),
        Column("high_roll_rms", "mV", "v_d above 100 Hz in the roll, rms"),
        Column("high_rest_rms", "mV", "v_d above 100 Hz at rest, rms"),
        Column("largest_tangential", "N", "Largest F_t in the roll"),
        Column("axis_offset", "mm", "Rotary axis above the contact"),
        Column("axis_offset_error", "mm", "Standard error"),
        Column(
            "ridge_lifted",
            "",
            "SIMULATED truth: the ridge left the head",
            origin="put in by the World",
        ),
        *TOUCHED,
        *CALIBRATED,
        Column("roll_from", "s", "Start of the roll, since the start of the record"),
        Column("roll_to", "s", "End of the roll, since the start of the record"),
        *RECORDED,
    ),
    plots=(
        Plot(
            "peaks",
            "peak_1",
            ("trial",),
            auxiliary=("peak_2",),
            title="Largest excursions of both strips by trial",
        ),
    ),
    traces=(
        Trace("data", "signals", "v_d", ("v_1", "v_2"), title="Differential PVDF signal"),
        Trace("force", "force", "F_n", ("F_t",), title="Forces"),
        Trace("position", "position", "x", ("z", "z_commanded"), title="Positions"),
        Trace("rotation", "rotation", "angle", ("angle_commanded",), title="Rotation"),
    ),
)
