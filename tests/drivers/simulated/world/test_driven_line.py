"""The vibrator line's history: exact across changes of the drive, the same however it is asked."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from drivers.simulated.ports import Excitation
from drivers.simulated.world import driven_line
from drivers.simulated.world.driven_line import DrivenLine
from rig.physics.modal import ModalSystem, lag, resonance

LINE = ModalSystem.from_chains(
    [resonance(90.0, 3.0, 12.0) * lag(400.0), lag(400.0)],
)
GAIN_OF_LAG = 2 * np.pi * 400.0


def sine(frequency: float, amplitude: float, **more: object) -> Excitation:
    return Excitation(
        **{  # type: ignore[arg-type]
            "on": True,
            "function": "SIN",
            "frequency_Hz": frequency,
            "amplitude_V": amplitude,
            "offset_V": 0.0,
            "phase_rad": 0.0,
            **more,
        }
    )


def history(*changes: tuple[int, Excitation]) -> DrivenLine:
    line = DrivenLine(LINE)
    for now_us, excitation in changes:
        line.excite(now_us, excitation)
    return line


CHANGES = (
    (1_000, sine(100, 0.5)),
    (4_333, sine(250, 1.5)),
    (9_000, sine(250, 1.5, on=False)),
    (12_000, sine(100, 1.0, offset_V=0.3)),
    (15_000, sine(100, 0.2, function="DC", offset_V=-1.0)),
)
TIMES = np.arange(0, 20_000, 7) * 1e-6


def drive(times: np.ndarray) -> np.ndarray:
    """What a direct digital synthesiser puts out: its phase goes on through every change."""
    value = np.zeros_like(times)
    edges = [now * 1e-6 for now, _ in CHANGES] + [np.inf]
    phase = 0.0
    for (_, excitation), begin, end in zip(CHANGES, edges[:-1], edges[1:], strict=True):
        inside = (times >= begin) & (times < end)
        turns = 2 * np.pi * excitation.frequency_Hz
        if excitation.on:
            amplitude = excitation.amplitude_V if excitation.function == "SIN" else 0.0
            value[inside] = excitation.offset_V + amplitude * np.sin(
                phase + turns * (times[inside] - begin)
            )
        phase += turns * (end - begin) if np.isfinite(end) else 0.0
    return value


def test_samples_across_changes_of_the_drive_equal_a_fine_integration() -> None:
    """An independent solver (first-order lag, scipy's lsim) on a grid with every change on it."""
    grid = np.arange(0, 20_001) * 1e-6
    _, expected, _ = lsim(([GAIN_OF_LAG], [1, GAIN_OF_LAG]), drive(grid), grid)
    got = history(*CHANGES).output(1, grid)
    # lsim joins the drive's samples by straight lines; at a step that is half a sample early.
    assert np.abs(got - expected).max() < 2e-3 * np.abs(expected).max()
    assert np.abs(expected).max() > 0.5


def test_nothing_moves_before_the_first_drive() -> None:
    assert not history(*CHANGES).output(0, np.arange(0, 1000, 10) * 1e-6).any()


def test_the_output_has_no_jump_where_the_drive_changes() -> None:
    line = history(*CHANGES)
    for now_us, _ in CHANGES:
        around = now_us * 1e-6 + np.array([-1e-9, 1e-9])
        before, after = line.output(1, around)
        assert after - before == pytest.approx(0, abs=1e-4)


def test_asked_in_blocks_late_or_twice_it_is_the_same() -> None:
    line = history(*CHANGES)
    whole = line.output(0, TIMES)
    assert (line.output(0, TIMES) == whole).all()
    for size in (1, 7, 64, 1000):
        blocks = [line.output(0, TIMES[k : k + size]) for k in range(0, len(TIMES), size)]
        assert np.abs(np.concatenate(blocks) - whole).max() < 1e-12
    later = history(*CHANGES, (30_000, sine(3, 5.0)), (40_000, sine(4, 1.0)))
    assert (later.output(0, TIMES) == whole).all(), "what comes later does not change the past"


def test_a_drive_set_again_unchanged_changes_nothing() -> None:
    once = history((0, sine(100, 1.0)))
    often = history(*((now, sine(100, 1.0)) for now in range(0, 20_000, 1_300)))
    assert np.abs(once.output(0, TIMES) - often.output(0, TIMES)).max() < 1e-12


def test_two_changes_at_one_instant_leave_the_last() -> None:
    both = history((1_000, sine(50, 9.0)), (1_000, sine(100, 1.0)))
    last = history((1_000, sine(100, 1.0)))
    assert np.abs(both.output(0, TIMES) - last.output(0, TIMES)).max() < 1e-12


def test_forgetting_the_distant_past_does_not_change_the_recent_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    changes = [(now, sine(100, 1.0 + now % 3)) for now in range(0, 50_000, 70)]
    recent = np.linspace(45_000, 55_000, 500) * 1e-6
    everything = history(*changes).output(0, recent)
    monkeypatch.setattr(driven_line, "SEGMENTS_KEPT", 100)
    assert (history(*changes).output(0, recent) == everything).all()
