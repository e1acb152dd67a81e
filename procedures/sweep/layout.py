"""What a sweep's readings hold, and how they become the plots of its run file."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from procedures.pressed.contact import ZERO_COLUMNS
from rig.files.journal.layout import Column, Layout, Plot
from rig.run.points import Reading

if TYPE_CHECKING:
    from rig.analysis.response.complex_response import Response
    from rig.analysis.response.sine_fit import SineFit


def reading_of(response: Response, load: SineFit, voltage: SineFit, settled_at_s: float) -> Reading:
    """One frequency's reading: response with its errors, both tones, when it was taken."""
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
    """A fitted tone as columns of the reading."""
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
        Column("frequency", "frequency_Hz", "Hz", "Frequency (Hz)"),
        Column("gain", "gain_dB", "dB", "Gain (dB re 1 V/N)"),
        Column("gain_error", "gain_standard_error_dB", "dB", "Standard error of the gain (dB)"),
        Column("phase", "phase_deg", "deg", "Phase (deg)"),
        Column("phase_error", "phase_standard_error_deg", "deg", "Standard error (deg)"),
        Column("coherence", "coherence", "", "Squared coherence"),
        Column("response_real", "response_real_V_N", "V/N", "Response, real part (V/N)"),
        Column("response_imag", "response_imag_V_N", "V/N", "Response, imaginary part (V/N)"),
        Column("response_var_real", "response_var_real", "V^2/N^2", "Variance, real (V^2/N^2)"),
        Column("response_var_imag", "response_var_imag", "V^2/N^2", "Variance, imag. (V^2/N^2)"),
        Column("response_cov", "response_cov_real_imag", "V^2/N^2", "Covariance (V^2/N^2)"),
        Column("load_amplitude", "load_amplitude_N", "N", "Load, peak (N)"),
        Column("load_phase", "load_phase_deg", "deg", "Load phase (deg)"),
        Column("load_distortion", "load_distortion", "", "Harmonic distortion of the load"),
        Column("load_residual", "load_residual_rms_N", "N", "Load residual, rms (N)"),
        Column("voltage_amplitude", "voltage_amplitude_V", "V", "Film voltage, peak (V)"),
        Column("voltage_phase", "voltage_phase_deg", "deg", "Film voltage phase (deg)"),
        Column("voltage_distortion", "voltage_distortion", "", "Harmonic distortion of the film"),
        Column("voltage_residual", "voltage_residual_rms_V", "V", "Film residual, rms (V)"),
        Column("load_set", "load_set_N", "N", "Load asked for, peak (N)"),
        Column("repeat", "repeat", "", "Repeat"),
        Column("drive", "drive_V", "V", "Generator amplitude, peak (V)"),
        Column("preload", "preload_N", "N", "Preload (N)"),
        Column("degrees", "degrees", "", "Degrees of freedom of the fit"),
        Column("records", "records", "", "Records that count"),
        Column("taken", "taken_s", "s", "Time the point took (s)"),
        Column("physics", "physics_s", "s", "Time of waits and records in it (s)"),
        Column("largest_load", "largest_load_N", "N", "Largest load on the way, peak (N)"),
        Column("settled_at", "settled_at_s", "s", "Time of the record's end (s)"),
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
