"""What a roll trial records, what its readings hold, and how its file shows both."""

from __future__ import annotations

from procedures.pressed import layout as pressed_layout
from procedures.pressed.layout import ASKED, CALIBRATED, HELD, RECORDED, TOUCHED
from rig.files.journal.layout import Column, Layout, Plot, Trace
from rig.run.procedure import StreamPlan

STREAMS = (
    *pressed_layout.STREAMS,
    StreamPlan(
        "rotation",
        "rotary",
        ("angle", "angle_commanded"),
        "Angle of the object from upright, measured and commanded, at the ticks",
        "<f8",
        "deg",
    ),
)

LAYOUT = Layout(
    definition="NXrig_roll_trial",
    version="2",
    columns=(
        *ASKED,
        Column("start_on_skin", "start_on_skin_mm", "mm", "Begin of the roll on the skin (mm)"),
        Column("angle", "angle_deg", "deg", "Largest angle from upright (deg)"),
        Column("angle_error", "angle_error_deg", "deg", "Error of the angle at rest (deg)"),
        Column("angle_lag", "angle_lag_deg", "deg", "Largest error of the angle underway (deg)"),
        *HELD,
        Column("peak_1", "peak_1_mV", "mV", "Largest excursion of v_1 on the way there (mV)"),
        Column("peak_2", "peak_2_mV", "mV", "Largest excursion of v_2 on the way there (mV)"),
        Column("above_100_Hz", "above_100_Hz_percent", "%", "Energy of v_d above 100 Hz (%)"),
        Column("largest_tangential", "largest_tangential_N", "N", "Largest F_t in the roll (N)"),
        Column("axis_offset", "axis_offset_mm", "mm", "Rotary axis above the contact (mm)"),
        Column("axis_offset_error", "axis_offset_error_mm", "mm", "Standard error (mm)"),
        Column("ridge_lifted", "ridge_lifted", "", "SIMULATED truth: the ridge left the head"),
        *TOUCHED,
        *CALIBRATED,
        Column("roll_from", "roll_from_s", "s", "Begin of the roll, since the record's (s)"),
        Column("roll_to", "roll_to_s", "s", "End of the roll, since the record's (s)"),
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
