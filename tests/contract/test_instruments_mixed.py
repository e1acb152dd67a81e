"""The same sweep with other instruments and links: the procedure does not know the difference."""

from __future__ import annotations

import pytest

from rig.model.vibrator import drawn_film, true_response
from rig.recording.runfile import RunFile
from rig.recording.verify import verify

FREQUENCIES = "20,210,2100,15000"


@pytest.mark.parametrize("daq", ["U2331A", "U2542A"])
@pytest.mark.parametrize("link", ["socket", "hislip"])
def test_every_combination_measures_the_film(rig, daq, link):
    world = rig.world(f'daq_model = "{daq}"\ngenerator_link = "{link}"\n')
    ended = rig.sweep("--frequencies", FREQUENCIES, "--seed", "5", "--world", world)

    assert ended.code == 0, ended.stderr
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert next(i for i in run.header.instruments if i.role == "daq").model == daq
        truth = true_response(run.column("frequency"), *drawn_film(5))
        for part, variance in (("real", "real"), ("imag", "imag")):
            pull = (run.column(f"response_{part}") - getattr(truth, part)) / (
                run.column(f"response_var_{variance}") ** 0.5
            )
            assert abs(pull).max() < 4.5
