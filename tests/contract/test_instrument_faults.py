"""Instruments that fall silent, lie, or go away: one line, safe, exit 3; worse is exit 7."""

from __future__ import annotations

import pytest

from rig.recording.verify import verify

FREQUENCIES = ("--frequencies", "20,210,310,410,510")


@pytest.mark.parametrize("kind", ["silence", "garbage", "close", "truncate", "stale"])
@pytest.mark.parametrize("command", ["WAV:DATA", "DIG", "WAV:COMP"])
def test_a_daq_that_fails_once_ends_the_run_safely(rig, kind, command):
    plan = f'[[fault]]\ndevice = "daq"\nkind = "{kind}"\ncommand = "{command}"\nat = 3\n'
    ended = rig.sweep(*FREQUENCIES, "--fault", rig.fault(plan))

    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith("error: daq: ")
    assert command in error
    assert "; " in error, "the remedy follows the cause"
    assert rig.outputs() == [True, False]
    assert ended.object["points_done"] == 2
    assert verify(rig.only("*.h5")) == []


@pytest.mark.parametrize("kind", ["silence", "garbage", "close", "truncate"])
def test_a_generator_that_fails_once_is_still_switched_off(rig, kind):
    plan = f'[[fault]]\ndevice = "generator"\nkind = "{kind}"\ncommand = "SOUR1:FREQ"\nat = 4\n'
    ended = rig.sweep(*FREQUENCIES, "--fault", rig.fault(plan))

    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith("error: generator: SOUR1:FREQ")
    assert rig.outputs() == [True, False]
    assert "switched off: generator output" in ended.stderr


def test_an_off_that_fails_too_is_told_after_the_first_cause(rig):
    plan = (
        '[[fault]]\ndevice = "daq"\nkind = "silence"\ncommand = "DIG"\nat = 2\n'
        '[[fault]]\ndevice = "generator"\nkind = "silence"\ncommand = "OUTP1 0"\nat = 2\n'
        "count = 0\n"
    )
    ended = rig.sweep(*FREQUENCIES, "--fault", rig.fault(plan))

    assert ended.code == 7, ended.stderr
    first, second = ended.errors
    assert first.startswith("error: daq: DIG")
    assert "NOT SAFE: generator output" in second
    assert "the guard could not make the bench safe either" in ended.stderr
    assert ended.object["points_done"] == 1
    assert verify(rig.only("*.h5")) == []


def test_an_off_that_fails_once_is_done_by_the_guard(rig):
    plan = (
        '[[fault]]\ndevice = "daq"\nkind = "silence"\ncommand = "DIG"\nat = 2\n'
        '[[fault]]\ndevice = "generator"\nkind = "silence"\ncommand = "OUTP1 0"\nat = 2\n'
        "count = 1\n"
    )
    ended = rig.sweep(*FREQUENCIES, "--fault", rig.fault(plan))

    assert ended.code == 7, ended.stderr
    assert "the guard then made the bench safe" in ended.stderr
    assert rig.outputs()[-1] is False


def test_a_bench_that_does_not_answer_at_all_is_told_with_every_device(rig):
    plan = "".join(
        f'[[fault]]\ndevice = "{device}"\nkind = "silence"\ncount = 0\n'
        for device in ("generator", "daq")
    )
    ended = rig.sweep(*FREQUENCIES, "--fault", rig.fault(plan))

    assert ended.code == 3
    (error,) = ended.errors
    assert "generator: *IDN?" in error
    assert "daq: *IDN?" in error
    assert not list(rig.results.rglob("*.h5"))


def test_a_film_that_is_not_connected_is_told(rig):
    ended = rig.sweep(*FREQUENCIES, "--world", rig.world('film = "open-circuit"\n'))

    assert ended.code == 3
    (error,) = ended.errors
    assert "film: signal at 20 Hz" in error
    assert "no more than noise" in error
    assert rig.outputs() == [True, False]


def test_a_saturated_input_is_told_and_the_points_before_it_are_kept(rig):
    ended = rig.sweep(*FREQUENCIES, "--world", rig.world("film_gain = 40\n"))

    assert ended.code == 3
    (error,) = ended.errors
    assert "channel film at 210 Hz" in error
    assert "1.25 V range" in error
    assert "choose a larger range" in error
    assert ended.object["points_done"] == 1
    assert rig.outputs() == [True, False]
