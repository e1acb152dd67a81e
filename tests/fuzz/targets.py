"""What is fuzzed: functions of arbitrary bytes, each with the errors that are answers to them.

Anything else that one raises is a defect, and so is an input over which it takes long.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Callable
from pathlib import Path

from drivers.me_gsv8.frames import Decoder
from drivers.oriental_az.link import BrokenAnswerError, _first_frame
from drivers.simulated.faults.plan import FaultPlan
from drivers.zaber_rst.frames import ZaberFrameError, reply
from rig.bench.plan import parse_bench
from rig.core.errors import RigError
from rig.core.units import is_unit, quantity
from rig.files.errors import JournalError
from rig.files.imported.lvm import MAGIC as LVM
from rig.files.imported.lvm import read_lvm
from rig.files.imported.text import read_text
from rig.files.journal.format import MAGIC, BadRecord, RecordKind, decode, json_record
from rig.files.journal.reader import read_journal
from rig.files.journal.values import RunHeader

FOLDER = Path(tempfile.mkdtemp(prefix="rig-fuzz-"))
CORPUS = Path(__file__).parent / "corpus"


def units(data: bytes) -> None:
    """A quantity as it is typed."""
    text = data.decode("utf-8", "replace")
    is_unit(text)
    with contextlib.suppress(ValueError):
        quantity(text, "mm")


def bench_file(data: bytes) -> None:
    """The text of a bench file."""
    with contextlib.suppress(RigError):
        parse_bench(data.decode("utf-8", "replace"), "bench.toml")


def fault_plan(data: bytes) -> None:
    """A fault plan."""
    path = FOLDER / "fault.toml"
    path.write_bytes(data)
    with contextlib.suppress(RigError):
        FaultPlan.read(path)


def gsv_frames(data: bytes) -> None:
    """Bytes from the amplifier, whole and cut in two: the same frames."""
    whole, cut = Decoder(), Decoder()
    frames = whole.feed(data)
    middle = len(data) // 2
    twice = [*cut.feed(data[:middle]), *cut.feed(data[middle:])]
    assert sum(map(_size, frames)) == sum(map(_size, twice))


def _size(frame: object) -> int:
    return int(getattr(frame, "size", 0))


def modbus_frames(data: bytes) -> None:
    """Bytes from a drive on a serial line."""
    try:
        frame, rest = _first_frame(data)
    except BrokenAnswerError:
        return
    assert (frame or b"") + rest == data


def zaber_lines(data: bytes) -> None:
    """A line from the rotary stage."""
    with contextlib.suppress(ZaberFrameError):
        reply(data)


def text_import(data: bytes) -> None:
    """A text file of another program."""
    with contextlib.suppress(RigError):
        read_text(data, "x.csv").values([0, 1])


def lvm_import(data: bytes) -> None:
    """An LVM file of another program."""
    with contextlib.suppress(RigError):
        read_lvm(LVM + data, "x.lvm").values([0])


HEADER = json.loads((CORPUS / "header.json").read_text())
RUN_HEADER = RunHeader.model_validate(HEADER)


def journal(data: bytes) -> None:
    """A journal: arbitrary bytes after its header."""
    path = FOLDER / "x.rigj"
    path.write_bytes(MAGIC + json_record(RecordKind.HEADER, HEADER) + data)
    with contextlib.suppress(JournalError):
        read_journal(path)


def journal_record(data: bytes) -> None:
    """The content of one record of a journal, whose checksum is right."""
    if not data:
        return  # no record is empty
    with contextlib.suppress(BadRecord):
        decode(data, RUN_HEADER)


TARGETS: dict[str, Callable[[bytes], None]] = {
    one.__name__: one
    for one in (
        units, bench_file, fault_plan, gsv_frames, modbus_frames, zaber_lines, text_import,
        lvm_import, journal, journal_record,
    )
}  # fmt: skip
