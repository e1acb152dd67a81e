"""The columns of a sweep's readings, and the plots of its run file."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from procedures.pressed.approach.tare import ZERO_COLUMNS
from rig.files.journal.layout import Column, Layout, Plot
from rig.run.points import Reading

if TYPE_CHECKING:
    from rig.analysis.response.complex_response import Response
    from rig.analysis.response.sine_fit import SineFit


def reading_of(response: Response, load: SineFit, voltage: SineFit, settled_at_s: float) -> Reading:
    """Return the reading of one frequency: response with its errors, both tones, and times."""
    return {
        "frequency_Hz": response.frequency_Hz,
        "gain_dB": response.gain_dB,
        "gain_standard_error_dB": response.gain_standard_error_dB,
        "phase_deg": response.phase_deg,
        "phase_standard_error_deg": response.phase_standard_error_deg,
        "coherence": response.coherence,
        "response_real_V_N": response.value.real,
        "response_imag_V_N": response.value.imag,
        "response_var_real": float(response.covariance[0, 0]),
        "response_var_imag": float(response.covariance[1, 1]),
        "response_cov_real_imag": float(response.covariance[0, 1]),
        **phasor_columns("load", "N", load),
        **phasor_columns("voltage", "V", voltage),
        "settled_at_s": settled_at_s,
    }


def phasor_columns(name: str, unit: str, tone: SineFit) -> Reading:
    """Return a fitted tone as columns of the reading."""
    return {
        f"{name}_amplitude_{unit}": tone.amplitude,
        f"{name}_phase_deg": math.degrees(math.atan2(tone.phasor.imag, tone.phasor.real)),
        f"{name}_distortion": tone.harmonic_distortion,
        f"{name}_residual_rms_{unit}": tone.residual_rms,
    }


LAYOUT = Layout(
    definition="NXrig_sweep",
    version="2",
    columns=(
        Column("frequency", "Hz", "Frequency", origin="set"),
        Column("gain", "dB", "Gain (dB re 1 V/N)", long_name="Gain (dB re 1 V/N)"),
        Column("gain_error", "dB", "Standard error of the gain", key="gain_standard_error_dB"),
        Column("phase", "deg", "Phase"),
        Column("phase_error", "deg", "Standard error", key="phase_standard_error_deg"),
        Column("coherence", "", "Squared coherence"),
        Column("response_real", "V/N", "Response, real part"),
        Column("response_imag", "V/N", "Response, imaginary part"),
        Column(
            "response_var_real",
            "V^2/N^2",
            key="response_var_real",
            long_name="Variance, real (V^2/N^2)",
        ),
        Column(
            "response_var_imag",
            "V^2/N^2",
            key="response_var_imag",
            long_name="Variance, imag. (V^2/N^2)",
        ),
        Column(
            "response_cov",
            "V^2/N^2",
            key="response_cov_real_imag",
            long_name="Covariance (V^2/N^2)",
        ),
        Column("load_amplitude", "N", "Load, peak"),
        Column("load_phase", "deg", "Load phase"),
        Column("load_distortion", "", "Harmonic distortion of the load"),
        Column("load_residual", "N", "Load residual, rms", key="load_residual_rms_N"),
        Column("voltage_amplitude", "V", "Film voltage, peak"),
        Column("voltage_phase", "deg", "Film voltage phase"),
        Column("voltage_distortion", "", "Harmonic distortion of the film"),
        Column("voltage_residual", "V", "Film residual, rms", key="voltage_residual_rms_V"),
        Column("load_set", "N", "Load asked for, peak", origin="set"),
        Column("repeat", "", "Repeat"),
        Column("drive", "V", "Generator amplitude, peak"),
        Column("preload", "N", "Preload"),
        Column("preload_error", "N", "Standard error of the preload", key="preload_error_N"),
        Column("degrees", "", "Degrees of freedom of the fit"),
        Column("records", "", "Valid records"),
        Column("taken", "s", "Time the point took"),
        Column("physics", "s", "Time of waits and records in it"),
        Column("largest_load", "N", "Largest load on the way, peak"),
        Column("settled_at", "s", "Time of the record's end"),
        *ZERO_COLUMNS,
    ),
    plots=(
        Plot(
            "data",
            "gain",
            ("frequency",),
            errors="gain_error",
            log_axes=("frequency",),
            title="Gain of the PVDF film against frequency",
        ),
        Plot(
            "phase",
            "phase",
            ("frequency",),
            errors="phase_error",
            log_axes=("frequency",),
            title="Phase of the film voltage against the load",
        ),
        Plot("coherence", "coherence", ("frequency",), log_axes=("frequency",)),
        Plot(
            "load",
            "load_amplitude",
            ("frequency",),
            auxiliary=("load_phase",),
            log_axes=("frequency",),
        ),
        Plot(
            "voltage",
            "voltage_amplitude",
            ("frequency",),
            auxiliary=("voltage_phase",),
            log_axes=("frequency", "voltage_amplitude"),
        ),
    ),
)
