"""What every trial with the skin pressed on an object records: streams and columns of its file."""

from __future__ import annotations

from procedures.pressed.contact import ZERO_COLUMNS
from rig.files.journal.layout import Column
from rig.run.procedure import StreamPlan

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
    ),
)

ASKED = (
    Column("trial", "trial", "", "Trial"),
    Column("set_normal_force", "set_normal_force_N", "N", "Set point of the normal force (N)"),
)
"""What was asked for."""

HELD = (
    *ZERO_COLUMNS,
    Column("contact", "contact_mm", "mm", "z of the contact (mm)"),
    Column("stiffness", "stiffness_N_mm", "N/mm", "Stiffness at the force (N/mm)"),
    Column("overshoot", "overshoot_percent", "%", "Overshoot of the approach (%)"),
    Column("mean_normal_force", "mean_normal_force_N", "N", "Mean normal force in the motion (N)"),
    Column("force_error_rms", "force_error_rms_percent", "%", "Force error, rms (%)"),
    Column("force_error_peak", "force_error_peak_percent", "%", "Force error, peak (%)"),
)
"""How contact was found and the force held."""

TOUCHED = (
    Column("clock_offset", "clock_offset_s", "s", "DAQ's clock behind the force's (s)"),
    Column("clock_offset_error", "clock_offset_error_s", "s", "Standard error (s)"),
    Column("touch_gain_1", "touch_gain_1_V_s_N", "V s/N", "S1 by rate of force (V s/N)"),
    Column("touch_gain_1_error", "touch_gain_1_error_V_s_N", "V s/N", "Standard error (V s/N)"),
    Column("touch_gain_2", "touch_gain_2_V_s_N", "V s/N", "S2 by rate of force (V s/N)"),
    Column("touch_gain_2_error", "touch_gain_2_error_V_s_N", "V s/N", "Standard error (V s/N)"),
)
"""What touch-down and tap tell: the two clocks, and how much each strip gives."""

CALIBRATED = (
    Column("load_scale_1", "load_scale_1_N_s_V", "N/s/V", "Load rate of S1 by volt (N/s/V)"),
    Column("load_scale_1_error", "load_scale_1_error_N_s_V", "N/s/V", "Standard error (N/s/V)"),
    Column("load_scale_2", "load_scale_2_N_s_V", "N/s/V", "Load rate of S2 by volt (N/s/V)"),
    Column("load_scale_2_error", "load_scale_2_error_N_s_V", "N/s/V", "Standard error (N/s/V)"),
    Column("load_rate_flat_to", "load_rate_flat_to_Hz", "Hz", "Load rates flat up to (Hz)"),
)
"""Volts as load rate."""

RECORDED = (
    Column("samples", "samples", "", "Rows of the strips"),
    Column("frames", "frames", "", "Frames of the force sensor"),
    Column("tick_rate", "tick_Hz", "Hz", "Ticks of the servo (Hz)"),
    Column("ticks", "ticks", "", "Ticks"),
    Column("late_ticks", "late_ticks", "", "Ticks that began late or were left out"),
    Column("missed_ticks", "missed_ticks", "", "Ticks that were left out"),
    Column("held_back_ticks", "held_back_ticks", "", "Ticks that told z nothing: it was busy"),
    Column("largest_lateness", "largest_lateness_s", "s", "Largest lateness of a tick (s)"),
    Column("invalid", "invalid", "", "Why the trial does not count", "text"),
    Column("filter_delay", "filter_delay_s", "s", "Delay of the anti-alias filter (s)"),
)
"""How the record went."""
