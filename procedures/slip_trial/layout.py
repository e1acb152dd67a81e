"""The columns of a slip trial's readings, and how the run file shows them and the streams."""

from __future__ import annotations

from procedures.pressed.record.layout import ASKED, CALIBRATED, GRIP, HELD, RECORDED, TOUCHED
from rig.files.journal.layout import Column, Layout, Plot, Trace

FRICTION = (
    Column("static_friction", "", "Static friction coefficient"),
    Column("static_friction_error", "", "Standard error: noise, and shift of the force zeros"),
    Column("kinetic_friction", "", "Kinetic friction coefficient"),
    Column("kinetic_friction_error", "", "Standard error: noise, and shift of the force zeros"),
    Column("no_friction", "", "Why there are no coefficients", "text"),
)
"""Columns of what a slide shows of the friction."""

RAMP = (
    Column("ramp_error_rms", "N", "Error of the tangential ramp, rms"),
    Column("ramp_to", "s", "End of the ramp, since the start of the record"),
)
"""Columns of trials whose tangential force follows a ramp."""

WEIGHT = (
    Column("outcome", "", "What became of a weight: held, averted or lost", "text"),
    Column("load", "N", "Weight that the contact had to hold"),
    Column("slid", "mm", "Largest travel of the weight since its force followed the ramp"),
    Column("force_used", "N", "Mean normal force at the end of the motion"),
    Column("least_force", "N", "Bound of what holds the weight: by the largest F_t/F_n over 5 ms"),
    Column("least_force_true", "N", "SIMULATED truth: the same by the static coefficient"),
)
"""Columns of trials in which a weight hangs on the contact."""

LAYOUT = Layout(
    definition="NXrig_slip_trial",
    version="3",
    columns=(
        *ASKED,
        Column("speed", "mm/s", "Speed of the slide", origin="set"),
        Column("direction", "", "Direction along x", origin="set"),
        *HELD,
        *FRICTION,
        *TOUCHED,
        *CALIBRATED,
        *RAMP,
        *GRIP,
        *WEIGHT,
        Column("slide_from", "s", "Start of the slide, since the start of the record"),
        Column("slide_to", "s", "End of the slide, since the start of the record"),
        *RECORDED,
    ),
    plots=(
        Plot(
            "friction",
            "static_friction",
            ("trial",),
            errors="static_friction_error",
            auxiliary=("kinetic_friction",),
            title="Friction coefficients by trial",
        ),
    ),
    traces=(
        Trace("data", "signals", "v_d", ("v_1", "v_2"), title="Differential PVDF signal"),
        Trace("force", "force", "F_n", ("F_t",), title="Forces"),
        Trace("position", "position", "x", ("z", "z_commanded"), title="Positions"),
    ),
)
