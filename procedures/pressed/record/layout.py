"""The streams and columns that every trial with the skin pressed on an object records."""

from __future__ import annotations

from procedures.pressed.approach.tare import ZERO_COLUMNS
from rig.files.journal.layout import Column
from rig.run.procedure import StreamPlan


def ages(*axes: str) -> StreamPlan:
    """Return the stream of the positions' ages for these axes."""
    return StreamPlan(
        "ages",
        "clock",
        axes,
        "Time from the latest look at each axis to the time of the row; an axis at rest is not "
        "looked at",
        "<f8",
        "s",
        times="ticks",
    )


STREAMS = (
    StreamPlan("strips", "daq", ("strip_1", "strip_2"), "PVDF strips, raw counts"),
    StreamPlan(
        "signals",
        "computed from strips",
        ("v_d", "v_1", "v_2"),
        "Strips at 1 kHz behind the anti-alias filter, v_d = v_1 - v_2",
        "<f8",
        "V",
    ),
    StreamPlan(
        "load_rate",
        "computed from signals",
        ("strip_1", "strip_2"),
        "Rate of load on the strips, where they are calibrated",
        "<f8",
        "N/s",
    ),
    StreamPlan(
        "bridges", "force_sensor", ("x", "y", "z"), "Force sensor, as it sent them", "<f4", ""
    ),
    StreamPlan(
        "force",
        "computed from bridges",
        ("F_n", "F_t", "F_y"),
        "Normal force, tangential force along x and force along y",
        "<f8",
        "N",
    ),
    StreamPlan(
        "ticks",
        "clock",
        ("elapsed",),
        "Times of the positions, since the record began",
        "<f8",
        "s",
    ),
    StreamPlan(
        "position",
        "stage_z, stage_x",
        ("z", "x", "z_commanded", "x_commanded"),
        "Positions measured and commanded, at the ticks",
        "<f8",
        "mm",
        times="ticks",
    ),
    ages("z", "x"),
)

ASKED = (
    Column("trial", "", "Trial", origin="set"),
    Column("set_normal_force", "N", "Set point of the normal force", origin="set"),
)
"""Columns of what was requested."""

HELD = (
    *ZERO_COLUMNS,
    Column("contact", "mm", "z of the contact"),
    Column("stiffness", "N/mm", "Stiffness at the force"),
    Column("overshoot", "%", "Overshoot of the approach"),
    Column("mean_normal_force", "N", "Mean normal force in the motion"),
    Column("force_error_rms", "%", "Force error, rms"),
    Column("force_error_peak", "%", "Force error, peak"),
)
"""Columns on how contact was found and the force held."""

TOUCHED = (
    Column("clock_offset", "s", "DAQ's clock behind the force's"),
    Column("clock_offset_error", "s", "Standard error"),
    Column("touch_gain_1", "V s/N", "S1 by rate of force"),
    Column("touch_gain_1_error", "V s/N", "Standard error"),
    Column("touch_gain_2", "V s/N", "S2 by rate of force"),
    Column("touch_gain_2_error", "V s/N", "Standard error"),
)
"""Columns from touch-down and tap: the offset of the two clocks, and the gain of each strip."""

CALIBRATED = (
    Column("load_scale_1", "N/s/V", "Load rate of S1 by volt", origin="calibrated"),
    Column("load_scale_1_error", "N/s/V", "Standard error", origin="calibrated"),
    Column("load_scale_2", "N/s/V", "Load rate of S2 by volt", origin="calibrated"),
    Column("load_scale_2_error", "N/s/V", "Standard error", origin="calibrated"),
    Column("load_rate_flat_to", "Hz", "Load rates flat up to", origin="calibrated"),
)
"""Volts as load rate."""

RECORDED = (
    Column("samples", "", "Rows of the strips"),
    Column("frames", "", "Frames of the force sensor"),
    Column("lost_frames", "", "Frames of the force sensor lost at one moment"),
    Column("tick_rate", "Hz", "Ticks of the servo", key="tick_Hz"),
    Column("ticks", "", "Ticks"),
    Column("late_ticks", "", "Ticks that began late or were left out"),
    Column("missed_ticks", "", "Ticks that were left out"),
    Column("held_back_ticks", "", "Ticks in which z got no command because it was busy"),
    Column("largest_lateness", "s", "Largest lateness of a tick"),
    Column("misread_positions", "", "Impossible positions that were read again"),
    Column("oldest_look", "s", "Longest time for which a moving axis was not seen"),
    Column("invalid", "", "Why the trial is invalid", "text"),
    Column("filter_delay", "s", "Delay of the anti-alias filter"),
    Column("detector", "", "Detector of slip during the trial", "text"),
    Column("detections", "", "What it found during the trial, as JSON", "text"),
    Column("x_moves", "", "Commands to x as JSON: from sample, mm/s, to sample", "text"),
    Column("held_forces", "", "Set points of F_n as JSON: from sample, N", "text"),
    Column(
        "cut_off_rows", "", "Rows with v_1 or v_2 outside the DAQ's range as JSON: from, to", "text"
    ),
)
"""Columns on the quality of the record."""

GRIP = (
    Column("alarms", "", "Slips detected in the motion"),
    Column("first_alarm", "s", "First of them, since the record began"),
    Column("squeezes", "", "Alarms upon which the grip raised the force"),
    Column("unanswered_alarms", "", "Alarms upon which it did not"),
    Column("squeeze_decided", "s", "From the first alarm's sample to the decision"),
    Column("squeeze_sent", "s", "From the first alarm's sample to the command to z"),
    Column("squeeze_acknowledged", "s", "From the first alarm's sample to z's answer"),
    Column("squeeze_risen", "s", "From the first alarm's sample to F_n + 10 % of the step"),
    Column("squeeze_record", "", "Every squeeze, as JSON", "text"),
)
"""Columns on the grip that answers alarms."""
