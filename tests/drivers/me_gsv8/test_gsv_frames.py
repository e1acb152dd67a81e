"""The GSV frame codec against the maker's examples, any chunking, garbage and flipped bits."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.me_gsv8.frames import (
    FLOAT32,
    INT16,
    INT24,
    Decoder,
    Frame,
    FrameLayout,
    GsvResponse,
    Measurements,
    crc16,
    crc16_by_place,
    request,
)

EIGHT_VALUES = bytes.fromhex(
    "AA 37 B0 C1 C7 CD 38 3F E6 19 7E 3F C0 B6 0B BF 49 7E 95 40 22 DD 1D 3F B2 11 53 3E E6 C3 72"
    "3F 92 65 3B E7 6E 85"
)
THREE_FLOATS = FrameLayout(3, FLOAT32, crc=True)
NASTY = st.binary(min_size=12, max_size=12) | st.lists(
    st.sampled_from([0xAA, 0x85, 0x32, 0xB0, 0x70, 0x00]), min_size=12, max_size=12
).map(bytes)
"""The data of three values, often full of what frames begin and end with."""


def measurement(data: bytes, status: int = 0, crc: bool = True) -> bytes:
    """A frame of three floats, put together by hand."""
    body = bytes((0x32 if crc else 0x12, 0xB0 | status)) + data
    return b"\xaa" + body + (struct.pack("<H", crc16(body)) if crc else b"") + b"\x85"


def strict(crc: bool = True) -> Decoder:
    """A decoder that knows what the stream looks like, as the driver's does."""
    decoder = Decoder()
    decoder.expected = FrameLayout(3, FLOAT32, crc)
    decoder.crc_only = crc
    return decoder


def data_of(frames: list[Frame]) -> list[bytes]:
    """The bytes of every measurement, in order."""
    runs = [frame for frame in frames if isinstance(frame, Measurements)]
    return [row.astype(">f4").tobytes() for run in runs for row in run.values]


# --- the maker's examples --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "parameters", "crc", "wire"),
    [
        (0x23, b"", False, "AA 90 23 85"),
        (0x24, b"", False, "AA 90 24 85"),
        (0x8B, struct.pack(">f", 1000), False, "AA 94 8B 44 7A 00 00 85"),
        (0x23, b"", True, "AA B0 23 A6 85"),
        (0x01, b"\x08", True, "AA B1 01 08 AC 85"),
    ],
)
def test_requests(command: int, parameters: bytes, crc: bool, wire: str) -> None:
    assert request(command, parameters, crc) == bytes.fromhex(wire)


def test_a_request_of_sixteen_parameter_bytes_is_refused() -> None:
    with pytest.raises(ValueError, match="16 parameter bytes"):
        request(0x15, bytes(16))


def test_responses() -> None:
    decoder = Decoder()
    wire = "AA 50 00 85  AA 70 00 A2 85  AA 50 41 85  AA 54 00 44 7A 00 00 85"
    assert decoder.feed(bytes.fromhex(wire)) == [
        GsvResponse(0, b"", crc=False),
        GsvResponse(0, b"", crc=True),
        GsvResponse(0x41, b"", crc=False),
        GsvResponse(0, struct.pack(">f", 1000), crc=False),
    ]
    assert decoder.dropped == 0


def test_a_response_of_fifteen_bytes_and_more_says_its_length_where_the_code_would_be() -> None:
    decoder = Decoder()
    data = bytes(range(20))
    (answer,) = decoder.feed(b"\xaa\x5f\x05" + data + b"\x85")
    assert answer == GsvResponse(0, data, crc=False)


def test_the_makers_measurement_with_crc() -> None:
    decoder = Decoder()
    (run,) = decoder.feed(EIGHT_VALUES)
    assert isinstance(run, Measurements)
    assert run.layout == FrameLayout(8, FLOAT32, crc=True)
    assert run.values[0].tolist() == pytest.approx(
        [-24.9752, 1.79765, 1.50556, -0.787088, 2.54475, 1.39115, 0.450710, 1.14371], rel=1e-5
    )
    assert run.status.tolist() == [0]


@pytest.mark.parametrize(
    ("data_type", "wire", "values"),
    [
        (INT16, "AA 12 90 80 00 00 00 FF FF 85", [0.0, -1.05, 1.05 * (1 - 2**-15)]),
        (INT24, "AA 12 A1 800000 000000 FFFFFF 85", [0.0, -1.05, 1.05 * (1 - 2**-23)]),
    ],
)
def test_integers_are_offset_binary_with_1_05_ranges_at_their_end(
    data_type: int, wire: str, values: list[float]
) -> None:
    (run,) = Decoder().feed(bytes.fromhex(wire))
    assert isinstance(run, Measurements)
    assert run.layout.data_type == data_type
    assert run.values[0].tolist() == pytest.approx(values, rel=1e-6)


def test_status_bits_come_frame_by_frame() -> None:
    wire = b"".join(measurement(bytes(12), status) for status in (0, 1, 2, 3, 0))
    (run,) = strict().feed(wire)
    assert isinstance(run, Measurements)
    assert run.status.tolist() == [0, 1, 2, 3, 0]


def test_responses_between_measurements_keep_their_place() -> None:
    ok = bytes.fromhex("AA 70 00 A2 85")
    wire = measurement(bytes(12)) * 2 + ok + measurement(b"\x3f\x80\0\0" * 3)
    kinds = [type(frame) for frame in strict().feed(wire)]
    assert kinds == [Measurements, GsvResponse, Measurements]


# --- any bytes -------------------------------------------------------------------------------


@given(st.lists(NASTY, max_size=12), st.lists(st.integers(1, 40), max_size=30), st.booleans())
def test_any_chunking_gives_the_same_frames(data: list[bytes], cuts: list[int], crc: bool) -> None:
    wire = b"".join(measurement(one, crc=crc) for one in data)
    decoder, at, found = strict(crc), 0, list[Frame]()
    for cut in [*cuts, len(wire)]:
        found += decoder.feed(wire[at : at + cut])
        at += cut
    assert b"".join(data_of(found)) == b"".join(_as_floats(one) for one in data)
    assert decoder.dropped == 0


@given(st.binary(max_size=60), st.lists(NASTY, min_size=1, max_size=5))
def test_after_any_garbage_the_true_frames_come_and_the_garbage_is_counted(
    garbage: bytes, data: list[bytes]
) -> None:
    """What the garbage begins may take up to a longest frame: so much is sent afterwards."""
    tail = [struct.pack(">3f", k, k, k) for k in range(20)]
    decoder = strict()
    found = decoder.feed(garbage + b"".join(map(measurement, [*data, *tail])))
    assert data_of(found) == [_as_floats(one) for one in [*data, *tail]]
    assert decoder.dropped == len(garbage)
    assert decoder.take_rejected() == garbage[:64]


@given(st.lists(NASTY, min_size=1, max_size=6), st.data())
def test_a_flipped_bit_never_becomes_a_value(data: list[bytes], draw: st.DataObject) -> None:
    wire = bytearray(b"".join(map(measurement, data)))
    bit = draw.draw(st.integers(0, 8 * len(wire) - 1))
    wire[bit // 8] ^= 1 << bit % 8
    decoder = strict()
    found = data_of(decoder.feed(bytes(wire)))
    hit = bit // 8 // THREE_FLOATS.size
    kept = [_as_floats(one) for k, one in enumerate(data) if k != hit]
    assert found == kept or found == kept[:hit]  # the rest may wait behind a false beginning
    if found == kept and hit < len(data) - 1:
        assert decoder.dropped == THREE_FLOATS.size


def test_what_is_not_expected_is_no_frame() -> None:
    decoder = strict()
    ours = measurement(bytes(12))
    assert len(decoder.feed(EIGHT_VALUES + ours)) == 1
    assert decoder.take_rejected() == EIGHT_VALUES
    decoder.reset()
    assert decoder.feed(bytes.fromhex("AA 50 00 85") + ours)[0] != GsvResponse(0, b"", crc=False)


def test_reset_forgets_half_a_frame() -> None:
    decoder = strict()
    decoder.feed(measurement(bytes(12))[:9])
    decoder.reset()
    (run,) = decoder.feed(measurement(struct.pack(">3f", 1, 2, 3)))
    assert isinstance(run, Measurements)
    assert run.values.tolist() == [[1, 2, 3]]
    assert decoder.take_rejected() == b""


@given(st.integers(1, 40), st.integers(1, 20))
def test_both_ways_to_a_crc_agree(length: int, count: int) -> None:
    rows = np.random.default_rng([length, count]).integers(0, 256, (count, length), np.uint8)
    start, tables = crc16_by_place(length)
    found = np.bitwise_xor.reduce(tables[np.arange(length), rows], axis=1) ^ start
    assert found.tolist() == [crc16(row.tobytes()) for row in rows]


def _as_floats(data: bytes) -> bytes:
    """The same bytes after a journey through float32, which may quieten a NaN."""
    return np.frombuffer(data, ">f4").astype(np.float32).astype(">f4").tobytes()
