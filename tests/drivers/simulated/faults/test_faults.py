"""Faults on the wire: what a plan says, and what then reaches the client."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.simulated.faults.plan import DEVICES, DEVICES_BY_FAULT, FaultPlan
from drivers.simulated.faults.wire import Delivery, WireDialect, WireFaults, WireReply
from rig.core.errors import ConfigurationError

from ..ideal import IdealBench


def plan(**fault: object) -> FaultPlan:
    return FaultPlan.model_validate({"fault": [{"device": "daq", **fault}]})


def received(faults: WireFaults, requests: list[bytes]) -> list[bytes]:
    """What a client of one connection gets, reply after reply, to requests echoed in capitals."""
    link = faults.link()
    return [
        b"".join(reply.data for reply in link.exchange(request, request.upper() + b"\n").replies)
        for request in requests
    ]


FOUR = [b"a1?", b"a2?", b"a3?", b"a4?"]


def test_without_faults_everything_arrives() -> None:
    assert received(WireFaults(FaultPlan(), "daq"), FOUR[:2]) == [b"A1?\n", b"A2?\n"]


def test_silence_applies_from_the_nth_request_to_the_stated_number() -> None:
    faults = WireFaults(plan(kind="silence", at=2, count=2), "daq")
    assert received(faults, FOUR) == [b"A1?\n", b"", b"", b"A4?\n"]


def test_count_zero_is_for_ever_and_over_all_connections() -> None:
    faults = WireFaults(plan(kind="silence", at=3, count=0), "daq")
    assert received(faults, FOUR[:2]) == [b"A1?\n", b"A2?\n"]
    assert received(faults, FOUR * 3) == [b""] * 12


def test_only_matching_commands_are_counted_also_inside_a_message() -> None:
    faults = WireFaults(plan(kind="silence", command="WAV:DATA", at=2), "daq")
    requests = [b"WAV:STAT?", b"wav:data?", b"*IDN?", b"WAV:STAT?;:WAV:DATA?", b"WAV:DATA?"]
    assert [reply == b"" for reply in received(faults, requests)] == [0, 0, 0, 1, 0]


def test_only_requests_from_the_faults_moment_on_are_counted() -> None:
    bench = IdealBench()
    placed = plan(kind="silence", at=2, move=2, of="stage_x", after_s=0.5)
    faults = WireFaults(placed, "daq", bench=bench)
    assert b"" not in received(faults, FOUR), "nothing has begun"
    for device in ("stage_x", "stage_z", "stage_x"):
        bench.now_us += 900_000
        bench.tasks.begin(device, bench.now_us)
    assert b"" not in received(faults, FOUR), "half a second is not over"
    bench.now_us += 500_000
    assert received(faults, FOUR) == [b"A1?\n", b"", b"A3?\n", b"A4?\n"]


def test_a_fault_that_lasts_applies_to_everything_from_its_first_request_on() -> None:
    bench = IdealBench()
    faults = WireFaults(plan(kind="silence", at=2, for_s=0.1), "daq", bench=bench)
    assert received(faults, FOUR[:3]) == [b"A1?\n", b"", b""]
    bench.now_us += 99_000
    assert received(faults, FOUR[:1]) == [b""]
    bench.now_us += 1_000
    assert received(faults, FOUR[:1]) == [b"A1?\n"]


def test_other_devices_are_spared() -> None:
    faults = WireFaults(plan(kind="silence", count=0), "generator")
    assert received(faults, FOUR[:1]) == [b"A1?\n"]


def test_stale_reply_comes_in_front_of_the_next() -> None:
    faults = WireFaults(plan(kind="stale", at=2), "daq")
    assert received(faults, FOUR) == [b"A1?\n", b"", b"A2?\nA3?\n", b"A4?\n"]


def test_stale_reply_keeps_its_tag_and_its_connection() -> None:
    faults = WireFaults(plan(kind="stale"), "daq")
    first, second = faults.link(), faults.link()
    assert first.exchange(b"a?", b"A", tag=7) == Delivery()
    assert second.exchange(b"b?", b"B", tag=8).replies == (WireReply(b"B", 8),)
    assert first.exchange(b"set 1", None) == Delivery()
    assert first.exchange(b"c?", b"C", tag=9).replies == (WireReply(b"A", 7), WireReply(b"C", 9))


def test_garbage_is_unreadable_but_as_long_and_ended_alike() -> None:
    (reply,) = received(WireFaults(plan(kind="garbage"), "daq"), [b"+1.0E+00"])
    assert len(reply) == 9
    assert reply.endswith(b"\n")
    with pytest.raises(UnicodeDecodeError):
        reply.decode("ascii")


def test_truncated_reply_is_its_first_half() -> None:
    assert received(WireFaults(plan(kind="truncate"), "daq"), [b"abcdefg"]) == [b"ABCD"]


def test_close_and_reset_send_nothing_more() -> None:
    link = WireFaults(plan(kind="close"), "daq").link()
    assert link.exchange(b"a?", b"A") == Delivery(close=True)
    link = WireFaults(plan(kind="reset"), "daq").link()
    assert link.exchange(b"a?", b"A") == Delivery(close=True, reset=True)


def test_a_doubled_reply_comes_twice_with_its_tag() -> None:
    link = WireFaults(plan(kind="double"), "daq").link()
    assert link.exchange(b"a?", b"A", tag=7).replies == (WireReply(b"A", 7), WireReply(b"A", 7))
    assert link.exchange(b"b?", b"B", tag=8).replies == (WireReply(b"B", 8),)


def test_a_half_open_connection_is_one_and_the_others_are_not() -> None:
    faults = WireFaults(plan(kind="half-open", at=2), "daq")
    first, second = faults.link(), faults.link()
    assert first.exchange(b"a?", b"A").replies
    assert second.exchange(b"b?", b"B") == Delivery()
    assert (first.half_open, second.half_open) == (False, True)


CHECKED = WireDialect(
    error=lambda reply, code: b"E%d" % code if reply.startswith(b"OK") else None,
    checksum=lambda reply: reply[:-1] + b"!" if reply.endswith(b"#") else None,
)


def test_only_replies_that_can_carry_an_error_are_counted() -> None:
    faults = WireFaults(plan(kind="error", code=12, at=2), "daq", CHECKED)
    link = faults.link()
    got = [link.exchange(b"x", reply) for reply in (b"OK1", b"3.5", None, b"OK2", b"OK3")]
    sent = [b"".join(reply.data for reply in delivery.replies) for delivery in got]
    assert sent == [b"OK1", b"3.5", b"", b"E12", b"OK3"]


def test_only_replies_that_have_a_check_get_a_wrong_one() -> None:
    link = WireFaults(plan(kind="checksum"), "daq", CHECKED).link()
    assert [link.exchange(b"x", reply).replies[0].data for reply in (b"A", b"B#", b"C#")] == [
        b"A", b"B!", b"C#",
    ]  # fmt: skip


def test_what_is_done_is_reported_once_each_time_it_is_done() -> None:
    reported: list[str] = []
    link = WireFaults(plan(kind="silence", at=2, count=2), "daq", report=reported.append).link()
    for _ in range(5):
        link.exchange(b"a?", b"A")
    assert reported == ["silence", "silence"]


def test_plan_is_read_from_toml(tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text('[[fault]]\ndevice = "daq"\nkind = "stale"\nat = 3\ncommand = "WAV:DATA"\n')
    (fault,) = FaultPlan.read(path, devices=["daq", "generator"]).fault
    assert (fault.kind, fault.at, fault.count, fault.command) == ("stale", 3, 1, "WAV:DATA")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('[[fault]]\ndevice = "daq"\nkind = "explode"\n', "'kind' = 'explode' is unknown"),
        ('[[fault]]\ndevice = "daq"\n', "'kind' is missing"),
        ('[[fault]]\ndevice = "daq"\nkind = "stale"\nafter = 2\n', "after: unknown key"),
        ('[[fault]]\ndevice = "daq"\nkind = "stale"\nat = 0\n', "at = 0"),
        ('[[fault]]\ndevice = "dac"\nkind = "stale"\n', "'dac': no such device"),
        ("[[fault]\n", "faults.toml"),
        ("seed = 3\n", "seed: unknown key"),
        ('[[fault]]\ndevice = "daq"\nkind = "checksum"\n', "has no checksum of its own"),
        ('[[fault]]\ndevice = "generator"\nkind = "double"\n', "doubled message"),
        ('[[fault]]\ndevice = "daq"\nkind = "error"\n', "code: missing"),
        ('[[fault]]\ndevice = "daq"\nkind = "error"\ncode = 0\n', "code = 0 is not an error"),
        ('[[fault]]\ndevice = "daq"\nkind = "stuck"\n', "cannot happen to daq"),
        ('[[fault]]\ndevice = "daq"\nkind = "silence"\nmove = 1\n', "'daq' does not move"),
        (
            '[[fault]]\ndevice = "daq"\nkind = "overrun"\nmove = 1\nof = "stage_x"\n',
            "'stage_x' does not move on this bench",
        ),
        ('[[fault]]\ndevice = "daq"\nkind = "overrun"\nof = "stage_z"\n', "and no move"),
        (
            '[[fault]]\ndevice = "daq"\nkind = "stale"\nmove = 1\nacquisition = 2\n',
            "move = 1 and acquisition = 2",
        ),
        ('[[fault]]\ndevice = "daq"\nkind = "overrun"\nafter_s = -1.0\n', "after_s = -1.0 s"),
        ('[[fault]]\nkind = "silence"\n', "device: missing"),
    ],
)
def test_a_wrong_plan_is_refused_with_its_reason(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "faults.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=complaint):
        FaultPlan.read(path, devices=["daq", "generator"])


def test_a_missing_plan_is_a_configuration_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"none\.toml"):
        FaultPlan.read(tmp_path / "none.toml")


NEEDED = {
    "error": "code = 1",
    "clipped": "amplitude_V = 1.0",
    "clock-jump": "by_s = 1.0",
    "slow-sync": "delay_s = 0.1",
    "late": "by_s = 0.1",
    **dict.fromkeys(
        ("opened", "closed", "stuck-closed", "stuck-open", "bouncing"), 'name = "door"'
    ),
}
"""What a kind does not do without."""


@pytest.mark.parametrize("kind", DEVICES_BY_FAULT)
def test_every_kind_is_taken_for_its_devices_and_refused_for_all_others(
    tmp_path: Path, kind: str
) -> None:
    path = tmp_path / "faults.toml"
    for device in DEVICES:
        path.write_text(
            f'[[fault]]\ndevice = "{device}"\nkind = "{kind}"\n{NEEDED.get(kind, "")}\n'
        )
        if device in DEVICES_BY_FAULT[kind]:
            (fault,) = FaultPlan.read(path).fault
            assert (fault.device, fault.kind) == (device, kind)
        else:
            with pytest.raises(ConfigurationError, match=f"cannot happen to {device}"):
                FaultPlan.read(path)


def test_every_kind_stands_in_the_table_for_people() -> None:
    table = Path(__file__).parents[4] / "docs" / "fault-plans.md"
    rows = {
        line.split("|")[1].strip(" `") for line in table.read_text().splitlines() if "|" in line
    }
    assert rows - {"kind", "---"} == set(DEVICES_BY_FAULT)


def test_a_flipped_bit_changes_one_bit_where_the_reply_has_that_byte() -> None:
    assert received(WireFaults(plan(kind="flip", byte=-2, bit=1), "daq"), FOUR[:2]) == [
        b"A1=\n",
        b"A2?\n",
    ]
    assert received(WireFaults(plan(kind="flip", byte=100), "daq"), FOUR[:1]) == [b"A1?\n"]


def test_a_late_reply_is_the_same_and_later() -> None:
    link = WireFaults(plan(kind="late", by_s=0.3), "daq").link()
    late, next_one = link.exchange(b"a1?", b"A1?\n"), link.exchange(b"a2?", b"A2?\n")
    assert late == Delivery((WireReply(b"A1?\n"),), after_s=0.3)
    assert next_one == Delivery((WireReply(b"A2?\n"),))


def test_a_link_that_loses_every_third_reply() -> None:
    faults = WireFaults(plan(kind="silence", at=2, count=0, every=3), "daq")
    link = faults.link()
    got = [bool(link.exchange(b"a?", b"A").replies) for _ in range(8)]
    assert got == [True, False, True, True, False, True, True, False]


def test_the_reply_before_the_last_comes_with_its_own_number() -> None:
    link = WireFaults(plan(kind="before-last", at=3), "daq").link()
    replies = [link.exchange(b"a?", b"A%d" % tag, tag).replies for tag in range(4)]
    assert replies[2] == (WireReply(b"A0", 0),)
    assert replies[3] == (WireReply(b"A3", 3),)
    fresh = WireFaults(plan(kind="before-last"), "daq").link()
    assert fresh.exchange(b"a?", b"A").replies == ()


def test_jitter_adds_another_part_to_each_reply_and_the_same_in_every_run() -> None:
    def delays() -> list[float]:
        link = WireFaults(plan(kind="late", by_s=0.1, jitter_s=0.2, count=0), "daq").link()
        return [link.exchange(b"a?", b"A").after_s for _ in range(50)]

    assert delays() == delays()
    assert len(set(delays())) == 50
    assert all(0.1 <= delay <= 0.3 for delay in delays())
