"""The simulated rotary stage by itself: what it says, and how it turns in the World's time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from drivers.simulated.faults.plan import FaultPlan, RotaryFault
from drivers.simulated.instruments.zaber_rst import SimulatedRotarySettings, SimulatedRotaryStage

from ..ideal import IdealBench


class Talk:
    """A person at a terminal, without checks."""

    def __init__(self, *faults: dict[str, Any], **settings: Any):
        plan = FaultPlan.model_validate({"fault": [{"device": "rotary", **one} for one in faults]})
        self.bench = IdealBench()
        own = {"referenced": True, "start_deg": 0.0, **settings}
        self.stage = SimulatedRotaryStage(
            SimulatedRotarySettings(faults=plan.of(RotaryFault), **own), self.bench
        )

    def __call__(self, words: str, wait_s: float = 0.0) -> str:
        """The reply's status, flag and data."""
        exchange = self.stage.answer(f"1 1 {words}".encode(), "test")
        assert exchange is not None
        assert exchange.reply is not None
        self.bench.now_us += round(wait_s * 1e6)
        return exchange.reply.decode().strip().removeprefix("@01 1 ")

    @property
    def angle(self) -> float:
        return self.stage.angle_deg(self.bench.now_us)


@pytest.mark.parametrize(
    ("message", "reported"),
    [
        (b"/1 1 00 get pos:2C\n", b"@01 1 00 OK IDLE -- 0:0C\r\n"),
        (b"/\n", b"@01 0 OK IDLE -- 0\r\n"),
        (b"/0 0 07\r\n", b"@01 0 07 OK IDLE -- 0\r\n"),
        (b"noise/1 nonsense\n", b"@01 0 RJ IDLE -- BADCOMMAND\r\n"),
        (b"/1 2 home\n", b"@01 2 RJ IDLE -- BADAXIS\r\n"),
        (b"/2 get pos\n", None),
        (b"/1 1 00 get pos:2D\n", None),
        (b"get pos\n", None),
    ],
)
def test_what_it_answers_to_whom(message: bytes, reported: bytes | None) -> None:
    line = Talk().stage.line()
    exchanges = [*line.exchanges(message[:5], "test"), *line.exchanges(message[5:], "test")]
    assert [exchange.reply for exchange in exchanges] == ([] if reported is None else [reported])


def test_it_turns_along_a_trapezoid_at_exact_times() -> None:
    talk = Talk()
    assert talk("move abs 22400 52429 21") == "OK BUSY -- 0"
    speed, rate = 52429 / 1.6384 * 0.00015625, 21 / 1.6384e-4 * 0.00015625
    times_us = np.arange(0, 1_200_000, 1000)
    t = times_us * 1e-6
    ramp_s, end_s = speed / rate, 3.5 / speed + speed / rate
    rising = rate / 2 * np.minimum(t, ramp_s) ** 2 + speed * np.clip(t - ramp_s, 0, None)
    falling = 3.5 - rate / 2 * np.clip(end_s - t, 0, None) ** 2
    wanted = np.where(t > end_s - ramp_s, falling, rising)
    talk.bench.now_us = 1_200_000
    assert np.allclose(talk.stage.angles_deg(times_us), wanted, atol=1e-9)
    assert talk.stage.speed_deg_s(500_000) == pytest.approx(speed)
    assert talk("get encoder.pos") == "OK IDLE -- 22400"


def test_a_new_target_goes_over_from_the_speed_it_has() -> None:
    talk = Talk()
    talk("move abs 64000 104858 100", wait_s=0.5)
    before = talk.stage.speed_deg_s(talk.bench.now_us)
    assert talk("move abs 48000 104858 100") == "OK BUSY NI 0"
    assert talk.stage.speed_deg_s(talk.bench.now_us) == before > 9.0
    talk.bench.now_us += 3_000_000
    assert talk.angle == pytest.approx(7.5)


def test_without_reference_it_rejects_a_turn_and_knows_no_true_angle() -> None:
    talk = Talk(referenced=False, start_deg=40.0)
    assert talk("warnings") == "OK IDLE WR 02 WR WH"
    assert talk("get pos") == "OK IDLE WR 0"
    assert talk("move abs 100") == "RJ IDLE WR BADDATA"
    assert talk("home", wait_s=5.0) == "OK BUSY WR 0"
    assert talk("get pos") == "OK IDLE -- 0"
    assert talk.angle == 0.0


def test_a_stall_is_noticed_with_an_encoder_only() -> None:
    for encoder, flag in ((True, "FS"), (False, "--")):
        talk = Talk({"kind": "stuck", "move": 1, "after_s": 0.2}, encoder=encoder)
        talk("move abs 64000", wait_s=3.0)
        assert talk("").split()[2] == flag
        assert talk.angle < 5.0
    assert talk("get pos") == "OK IDLE -- 64000"
    assert talk("get encoder.pos") == "RJ IDLE -- BADCOMMAND"


def test_a_turned_knob_is_reported_until_the_next_command_to_move() -> None:
    talk = Talk({"kind": "knob", "after_s": 1.0, "by_deg": 2.0})
    talk("", wait_s=1.1)
    assert talk("", wait_s=2.0) == "OK BUSY NC 0"
    assert talk("warnings clear") == "OK IDLE NC 01 NC"
    assert talk.angle == pytest.approx(2.0)
    assert talk("move abs 0", wait_s=3.0) == "OK BUSY -- 0"
    assert talk("") == "OK IDLE -- 0"


@pytest.mark.parametrize("how", ["stop", "estop"])
def test_a_runaway_stage_passes_its_target_and_obeys_no_other_until_it_is_stopped(how: str) -> None:
    talk = Talk({"kind": "runaway", "move": 1, "after_s": 0.2})
    talk("move abs 64000 104858 100", wait_s=1.5)
    assert talk("move abs 32000 104858 100", wait_s=0.5) == "OK BUSY NI 0"
    assert talk.stage.speed_deg_s(talk.bench.now_us) == pytest.approx(10.0, rel=0.01)
    assert talk.angle > 18.0
    talk(how, wait_s=0.5)
    assert talk.stage.speed_deg_s(talk.bench.now_us) == 0.0
    talk("move abs 32000 104858 100", wait_s=5.0)
    assert talk.angle == pytest.approx(5.0)


@pytest.mark.parametrize(
    "ends",
    [{"kind": "warning-flag", "flag": "FQ"}, {"kind": "knob", "by_deg": 2.0}, None],
    ids=["fault", "knob", "home"],
)
def test_a_runaway_ends_with_whatever_else_ends_a_turn(ends: dict[str, Any] | None) -> None:
    others = () if ends is None else ({**ends, "after_s": 1.0},)
    talk = Talk({"kind": "runaway", "move": 1, "after_s": 0.2}, *others)
    talk("move abs 64000 104858 100", wait_s=1.5)
    if ends is None:
        talk("home", wait_s=3.0)
    talk("move abs 32000 104858 100", wait_s=5.0)
    assert talk.angle == pytest.approx(5.0)


def test_a_powerless_stage_turns_when_it_is_enabled() -> None:
    talk = Talk({"kind": "warning-flag", "flag": "FD", "move": 1, "after_s": 0.2})
    talk("move abs 64000", wait_s=1.0)
    assert talk("") == "OK IDLE FD 0"
    assert talk("move abs 0") == "RJ IDLE FD DRIVERDISABLED"
    talk("driver enable")
    assert talk("move abs 0") == "OK BUSY -- 0"


def test_settings_are_kept_and_limit_a_turn() -> None:
    talk = Talk()
    assert talk("set limit.max 1000") == "OK IDLE -- 0"
    assert talk("get limit.max") == "OK IDLE -- 1000"
    assert talk("move abs 1001") == "RJ IDLE -- BADDATA"
    assert talk("move max", wait_s=1.0) == "OK BUSY -- 0"
    assert talk("get pos") == "OK IDLE -- 1000"
    assert talk("set maxspeed 0") == "RJ IDLE -- BADDATA"
    assert talk("set accel fast") == "RJ IDLE -- BADDATA"
    assert talk("set colour 3") == "RJ IDLE -- BADCOMMAND"
