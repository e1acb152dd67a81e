"""What a disk holds of a file when the power fails while it is written, and what is read from it.

A trace is the calls on one file in their order. What the last completed sync covers is on the disk;
of the 4 KiB pages that were dirtied after it, any may be. Three writers of the same samples are
tried: the journal of a real run, and HDF5 files as a plain program writes them.
"""

from __future__ import annotations

import collections
import json
import pickle
import random
import signal
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rig.core.errors import RigError
from rig.files.runfile.reader import RunFile
from rig.files.runfile.recover import recover

PAGE = 4096
TRACED_RIG = Path(__file__).with_name("traced_rig.py")


@dataclass(frozen=True)
class Write:
    """These bytes went to this place of the file, which grew where it was shorter."""

    offset: int
    data: bytes


@dataclass(frozen=True)
class Truncate:
    """The file has this length now."""

    size: int


@dataclass(frozen=True)
class Sync:
    """All before is on the disk; ``rows`` are the samples that the writer then relies on."""

    rows: int = 0


Call = Write | Truncate | Sync


def contents(calls: Sequence[Call]) -> bytearray:
    """The file after these calls."""
    file = bytearray()
    for call in calls:
        if isinstance(call, Write):
            file.extend(bytes(max(call.offset - len(file), 0)))
            file[call.offset : call.offset + len(call.data)] = call.data
        elif isinstance(call, Truncate):
            file[call.size :] = bytes(max(call.size - len(file), 0))
    return file


def power_cut(calls: Sequence[Call], chance: random.Random, share: float) -> bytes:
    """A file that the disk may hold after these calls, where `share` of the unsynced pages came
    through. Its length is that of the calls, or ends with the last page that came through."""
    synced = 1 + max(n for n, call in enumerate(calls) if isinstance(call, Sync))
    disk, memory = contents(calls[:synced]), contents(calls)
    dirty = {
        page
        for call in calls[synced:]
        if isinstance(call, Write)
        for page in range(call.offset // PAGE, -(-(call.offset + len(call.data)) // PAGE))
    }
    arrived = sorted(page for page in dirty if chance.random() < share)
    ends = [len(disk), *(min(PAGE * (page + 1), len(memory)) for page in arrived)]
    length = chance.choice([max(ends), max(len(disk), len(memory))])
    disk.extend(bytes(length - len(disk)))
    for page in arrived:
        place = slice(PAGE * page, min(PAGE * (page + 1), len(memory)))
        disk[place] = memory[place]
    return bytes(disk)


def cut_somewhere(calls: Sequence[Call], chance: random.Random) -> Sequence[Call]:
    """The calls up to a random one behind the first sync; a write may have come half way."""
    first = next(n for n, call in enumerate(calls) if isinstance(call, Sync))
    begun = list(calls[: chance.randrange(first, len(calls)) + 1])
    if isinstance(last := begun[-1], Write):
        begun[-1] = Write(last.offset, last.data[: chance.randint(1, len(last.data))])
    return begun


# --- the journal of a real run ---------------------------------------------------------------


@dataclass
class RecordedRun:
    """A run's journal as it went to the disk, and what is in it, read without the program."""

    calls: list[Call] = field(default_factory=list)
    blocks: list[NDArray[np.int16]] = field(default_factory=list)
    """Rows of its one stream, in the order in which they were written."""
    ends: list[int] = field(default_factory=list)
    """Where in the file each block ends."""
    kept: list[tuple[int, str]] = field(default_factory=list)
    """Where the record of a kept point ends, and its id."""

    @classmethod
    def read(cls, trace: Path) -> RecordedRun:
        """The run of a trace that `traced_rig` has left."""
        run, size = cls(), 0
        with trace.open("rb") as file:
            while file.peek(1):
                data = pickle.load(file)
                if data is None:
                    run.calls.append(Sync())
                else:
                    run.calls.append(Write(size, data))
                    size += len(data)
        run._understand(bytes(contents(run.calls)))
        run.calls = list(run._with_rows())
        return run

    @property
    def samples(self) -> NDArray[np.int16]:
        """All rows, shape (rows, channels)."""
        return np.concatenate(self.blocks)

    def _understand(self, journal: bytes) -> None:
        at, channels = 8, 0
        while at < len(journal):
            length, checksum = struct.unpack_from("<II", journal, at)
            payload = journal[at + 8 : at + 8 + length]
            assert zlib.crc32(payload) == checksum
            at += 8 + length
            if payload[0] == 1:
                (stream,) = json.loads(payload[1:])["streams"]
                assert stream["dtype"] == "<i2"
                channels = len(stream["channels"])
            elif payload[0] == 2:
                rows = np.frombuffer(payload, "<i2", offset=struct.calcsize("<BHQd"))
                self.blocks.append(rows.reshape(-1, channels))
                self.ends.append(at)
            elif payload[0] == 5:
                self.kept.append((at, json.loads(payload[1:])["id"]))

    def _with_rows(self) -> Iterator[Call]:
        """The calls, each sync with the rows that it acknowledged."""
        size = 0
        for call in self.calls:
            if isinstance(call, Write):
                size += len(call.data)
            yield Sync(self.rows_until(size)) if isinstance(call, Sync) else call

    def rows_until(self, size: int) -> int:
        """Rows whose blocks lie whole in the journal's first `size` bytes."""
        return sum(len(b) for b, end in zip(self.blocks, self.ends, strict=True) if end <= size)


def trace_rig(rig: Any, *arguments: str) -> RecordedRun:
    """Run a real command to its end and give its journal's calls.

    The run file that the command left has to be the one that the traced bytes make: then no byte
    of the journal went another way.
    """
    trace = rig.folder / "trace"
    command = [sys.executable, str(TRACED_RIG), str(trace), *arguments]
    ended = subprocess.run(command, cwd=rig.folder, env=rig.env, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    recorded = RecordedRun.read(trace)
    (run_file,) = rig.results.rglob("*.h5")
    again = rig.folder / "again" / run_file.name
    again.parent.mkdir()
    again.with_suffix(".rigj").write_bytes(contents(recorded.calls))
    assert recover(again.with_suffix(".rigj")).read_bytes() == run_file.read_bytes()
    return recorded


# --- HDF5 files of the same samples ----------------------------------------------------------


def hdf5_calls(recorded: RecordedRun, path: Path, *, swmr: bool) -> list[Call]:
    """The same blocks appended to a dataset at `path`, flushed wherever the journal was synced.

    The file is looked at after every step: what a step changed are its writes. A flush counts as
    synced to the disk, which is more than h5py promises.
    """
    seen = bytearray()
    calls: list[Call] = []

    def look() -> None:
        now = path.read_bytes()
        if len(now) < len(seen):
            calls.append(Truncate(len(now)))
        calls.extend(
            Write(at, now[at : at + PAGE])
            for at in range(0, len(now), PAGE)
            if now[at : at + PAGE] != seen[at : at + PAGE]
        )
        seen[:] = now

    written = 0
    pending = list(recorded.blocks)
    with h5py.File(path, "w", libver="latest" if swmr else "earliest") as file:
        channels = pending[0].shape[1]
        counts = file.create_dataset(
            "counts", (0, channels), "<i2", maxshape=(None, channels), chunks=(PAGE, channels)
        )
        if swmr:
            file.swmr_mode = True
        for call in [Sync(0), *recorded.calls]:
            if not isinstance(call, Sync):
                continue
            while written < call.rows:
                block = pending.pop(0)
                counts.resize(written + len(block), axis=0)
                counts[written:] = block
                written += len(block)
                look()
            file.flush()
            look()
            calls.append(Sync(written))
    return calls


HDF5_READER = """
import signal, sys
import h5py, numpy
for line in sys.stdin:
    path, swmr = line.split()
    signal.alarm(2)  # a read takes milliseconds; ends the process in the middle of the library, too
    try:
        with h5py.File(path, "r", swmr=swmr == "True") as file:
            numpy.save(path + ".npy", file["counts"][()])
        print("read", flush=True)
    except Exception as error:
        print(type(error).__name__, flush=True)
"""


class Hdf5Reader:
    """A process that reads HDF5 files and may crash or hang at it."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def read(self, path: Path, *, swmr: bool) -> NDArray[np.int16] | str:
        """The samples, or why there are none."""
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-c", HDF5_READER],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{path} {swmr}\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline().strip()
        if not answer:
            number = -self._process.wait()
            self.close()
            return "hang" if number == signal.SIGALRM else signal.Signals(number).name
        if answer != "read":
            return answer
        saved = Path(f"{path}.npy")
        samples: NDArray[np.int16] = np.load(saved)
        saved.unlink()
        return samples

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


# --- judging ---------------------------------------------------------------------------------


@dataclass
class Tally:
    """What became of many files."""

    states: int = 0
    unreadable: int = 0
    lost: int = 0
    false: int = 0
    reasons: collections.Counter[str] = field(default_factory=collections.Counter)

    def unread(self, reason: str) -> None:
        """A file that cannot be read at all."""
        self.states += 1
        self.unreadable += 1
        self.reasons[reason] += 1

    def judge(
        self,
        found: NDArray[np.int16],
        true: NDArray[np.int16],
        acknowledged: int,
        points_are_there: bool = True,
    ) -> None:
        """Rows that were found, against those that were written and those that were relied on."""
        self.states += 1
        same = min(len(found), len(true))
        alike = (found[:same] == true[:same]).all(axis=1)
        right = same if alike.all() else int(np.argmin(alike))
        self.lost += right < acknowledged or not points_are_there
        self.false += right < len(found)

    @property
    def failed(self) -> int:
        """Files that were not as they should be."""
        return self.unreadable + self.lost + self.false

    def __str__(self) -> str:
        why = ", ".join(f"{count} {reason}" for reason, count in self.reasons.most_common())
        return (
            f"{self.states} states: {self.unreadable} unreadable{f' ({why})' if why else ''}, "
            f"{self.lost} lost acknowledged samples, {self.false} hold samples never written"
        )


def acknowledged_rows(calls: Sequence[Call]) -> int:
    """Rows that the last sync covered."""
    return next((call.rows for call in reversed(calls) if isinstance(call, Sync)), 0)


def recovered_samples(journal: Path) -> tuple[NDArray[np.int16], set[str]]:
    """All rows of the file that `recover` makes, in the order of the journal, and its points."""
    with RunFile.open(recover(journal)) as file:
        segments = {}
        for place in ("waveforms", "discarded", "between_points"):
            for data in file.entry[place].values() if place in file.entry else ():
                names = [data.attrs["signal"], *data.attrs["auxiliary_signals"]]
                segments[int(data.attrs["segment"])] = [data[name][()] for name in names]
        ordered = [np.stack(segments[n], axis=1) for n in sorted(segments)]
        return np.concatenate(ordered or [np.empty((0, 2), "<i2")]), set(file.point_ids())


SHARES = (0.1, 0.5, 0.9)


class JournalStates:
    """Journals as a disk may hold them, recovered and compared with what was written."""

    def __init__(self, run: RecordedRun, path: Path) -> None:
        self.tally = Tally()
        self._run = run
        self._path = path

    def prefixes(self) -> None:
        """The file after each of the calls, and after half of each write, from the first sync on:
        what a kill leaves."""
        calls = self._run.calls
        for end in range(1 + calls.index(Sync(0)), len(calls) + 1):
            self._judge(contents(calls[:end]), calls[:end])
            if isinstance(last := calls[end - 1], Write):
                half = [*calls[: end - 1], Write(last.offset, last.data[: len(last.data) // 2])]
                self._judge(contents(half), half)

    def power_cuts(self, count: int, chance: random.Random) -> None:
        """So many power cuts, the shares of surviving pages in turn."""
        for n in range(count):
            begun = cut_somewhere(self._run.calls, chance)
            self._judge(power_cut(begun, chance, SHARES[n % len(SHARES)]), begun)

    def _judge(self, state: bytes, begun: Sequence[Call]) -> None:
        self._path.with_suffix(".h5").unlink(missing_ok=True)
        self._path.write_bytes(state)
        try:
            found, points = recovered_samples(self._path)
        except RigError as error:
            self.tally.unread(error.message)
            return
        last_sync = max(n for n, call in enumerate(begun) if isinstance(call, Sync))
        synced = len(contents(begun[:last_sync]))
        relied_on = {point for end, point in self._run.kept if end <= synced}
        self.tally.judge(found, self._run.samples, acknowledged_rows(begun), relied_on <= points)


def hdf5_power_cuts(
    run: RecordedRun, path: Path, count: int, chance: random.Random, *, swmr: bool
) -> Tally:
    """The same power cuts with an HDF5 file in the journal's place."""
    calls, tally, reader = hdf5_calls(run, path, swmr=swmr), Tally(), Hdf5Reader()
    try:
        for n in range(count):
            begun = cut_somewhere(calls, chance)
            path.write_bytes(power_cut(begun, chance, SHARES[n % len(SHARES)]))
            found = reader.read(path, swmr=swmr)
            if isinstance(found, str):
                tally.unread(found)
            else:
                tally.judge(found, run.samples, acknowledged_rows(begun))
    finally:
        reader.close()
    return tally
