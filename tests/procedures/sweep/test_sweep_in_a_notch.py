"""Points at the bottom of a notch, where the film's own ringing has nearly the frequency of the
tone and no record averages over it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rig.analysis.response.curve import points_of
from rig.files.runfile.reader import RunFile
from rig.physics.film_clamp import FilmClampSettings, preload_gain
from rig.physics.vibrator import drawn_film, true_response

SEED = 8
"""Of a film with a notch of 16.7 dB and Q 17 at 463.7 Hz."""
AROUND_Hz = "451,454.6,456.9,459.2,461.452,463.7,465.3,466.045,468.4"


@pytest.mark.thorough
def test_points_under_small_loads_are_as_good_as_their_errors_say(rig: Any) -> None:
    ended = rig.sweep(
        *("--frequencies", AROUND_Hz, "--order", "descending"),
        *("--loads", "0.2,0.5,1,3,10", "--seed", str(SEED)),
    )
    assert ended.code == 0, ended.stderr
    with RunFile.open(rig.folder / ended.object["file"]) as run:
        frequency, response, _ = points_of(run.column)
        by_preload = FilmClampSettings().gain_per_newton_dB * run.column("preload_error")
        gain_dB = np.hypot(run.column("gain_error"), by_preload)
        phase_deg, preload_N = run.column("phase_error"), run.column("preload")
    truth = true_response(frequency, *drawn_film(SEED)) * preload_gain(
        FilmClampSettings(), preload_N
    )
    gain = 20 * np.log10(np.abs(response / truth)) / gain_dB
    phase = np.degrees(np.angle(response / truth)) / phase_deg
    assert np.abs(np.concatenate([gain, phase])).max() < 5  # it was 10
