"""Four channels of 250 kS/s for a minute through driver, link, run and recorder: what is lost?

The unit is simulated in a process of its own, over HiSLIP; its terminals carry a count, so that
every sample in the journal says which one it is.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_daq_stream.py``; `RIG_SECONDS=5` for a
look.
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from drivers.simulated.instruments.keysight_u2300a import KeysightU2300A
from drivers.simulated.transports.scpi_servers import HislipServer

MODEL, BITS_FULL_SCALE, RANGE_V = "U2541A", 32768, 10.0
RATE_S_S, SECONDS = 250e3, float(os.environ.get("RIG_SECONDS", "60"))
CHANNELS = {"first": 101, "second": 102, "third": 103, "fourth": 104}
APART = 10_000
"""Between the counts of two channels at one instant."""
BLOCK_ROWS = 2500
TICK_S = 0.01

pytestmark = [pytest.mark.benchmark, pytest.mark.short, pytest.mark.timeout(1200)]


def codes(first: int, rows: int) -> npt.NDArray[np.int16]:
    """What the converter gives from one sample on: (rows, 4), each channel counting round."""
    numbers = np.arange(first, first + rows)[:, None] + APART * np.arange(len(CHANNELS))
    return numbers.astype(np.int16)


BENCH = """
name = "stream"
[fixture]
mounted = "film-clamp"
[daq]
driver = "keysight-u2300a"
channels = { load_cell = 101, film = 103 }
resource = "TCPIP0::127.0.0.1::5025::SOCKET"
"""


class Counting:
    """A bench in real time whose terminals carry codes as volts."""

    @property
    def now_us(self) -> int:
        return time.monotonic_ns() // 1000

    def log(self, device: str, what: str, value: object, by: str) -> None:
        pass

    def begin_acquisition(self) -> int:
        return 0

    def volts(self, number: int, terminals: tuple[int, ...], *where: Any) -> Any:
        first, rows = where[2], where[3]
        return codes(first, rows) * (RANGE_V / BITS_FULL_SCALE)


async def serve() -> None:
    """Be the unit until the end of stdin."""
    bench = Counting()
    server = HislipServer(KeysightU2300A(MODEL, bench, bench))
    await server.start()
    print(server.port, flush=True)
    await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    await server.close()


def cpu_s(thread_ident: int) -> float:
    """Processor time that a thread has used."""
    return time.clock_gettime(time.pthread_getcpuclockid(thread_ident))


def test_a_minute_of_a_million_samples_a_second_loses_none(tmp_path: Path) -> None:
    import recorded_run
    from measured import heading, row

    from drivers.keysight_u2300a import driver as keysight_u2300a
    from rig.bench.plan import parse_bench
    from rig.core.clock import WallClock
    from rig.files.journal.format import Block
    from rig.files.journal.reader import read_journal
    from rig.files.journal.recorder import Recorder
    from rig.files.journal.writer import JournalWriter
    from rig.instruments.roles import Acquisition, InputChannel
    from rig.run.context import Run
    from rig.run.streams.sample_stream import SampleStream

    heading(
        f"{len(CHANNELS)} channels at {RATE_S_S:g} S/s for {SECONDS:g} s, blocks of {BLOCK_ROWS}"
    )
    stream = {
        "name": "strips", "device": "daq", "channels": list(CHANNELS), "dtype": "<i2",
        "row_shape": [len(CHANNELS)], "units": "count", "long_name": "counts",
    }  # fmt: skip
    path = tmp_path / "stream.rigj"
    recorder = Recorder(JournalWriter.create(path, recorded_run.header(streams=[stream])))
    unit = subprocess.Popen(
        [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert unit.stdin is not None
    assert unit.stdout is not None
    clock = WallClock()
    # The run needs a bench file; what is measured is the stream of its DAQ alone.
    plan = replace(parse_bench(BENCH, "bench.toml"), instruments=())
    bench: Any = SimpleNamespace(clock=clock, plan=plan, settings=plan.settings, instruments={})
    run = Run(None, bench, recorder, {"strips": 0}, bench.clock.now())
    resource = f"TCPIP::127.0.0.1::hislip0,{int(unit.stdout.readline())}::INSTR"
    daq = keysight_u2300a.connect(
        keysight_u2300a.Settings(resource=resource, channels=CHANNELS), clock
    )
    channels = tuple(InputChannel(name, RANGE_V) for name in CHANNELS)
    samples = SampleStream(daq, clock)
    own = cpu_s(recorder._thread.ident or 0)
    mine, begun, rows = time.thread_time(), time.perf_counter(), 0
    behind, queued, ticks = [], [], []
    samples.start(Acquisition(channels, RATE_S_S, BLOCK_ROWS))
    started_s = clock.now()
    while rows < RATE_S_S * SECONDS:
        tick = time.perf_counter()
        clock.sleep(TICK_S)
        while (record := samples.read()) is not None:
            assert record.first_index == rows
            run.streams.record_raw("strips", record)
            rows += len(record.counts)
        behind.append((clock.now() - started_s) - rows / RATE_S_S)
        queued.append(recorder.queued_bytes / 1e6)
        ticks.append(time.perf_counter() - tick)
    wall = time.perf_counter() - begun
    share = (cpu_s(recorder._thread.ident or 0) - own) / wall
    reading = (time.thread_time() - mine) / wall
    samples.stop()
    recorder.close()
    daq.close()
    unit.stdin.close()
    unit.wait(60)

    expected = 0
    for record in read_journal(path).records():
        if isinstance(record, Block):
            got = np.frombuffer(record.data, "<i2").reshape(-1, len(CHANNELS))
            assert record.first_index == expected
            assert (got == codes(expected, len(got))).all()
            expected += len(got)
    assert expected == rows
    print(f"{rows} rows of {len(CHANNELS)} in the journal, each the one it should be: none lost")
    row("a turn of the loop", 1e3 * np.array(ticks), "ms", 2)
    row("behind the unit", 1e3 * np.array(behind), "ms", 1)
    row("waiting for the disk", queued, "MB", 2)
    print(f"recorder's thread {100 * share:.1f} %, reader's {100 * reading:.1f} % of a core")


if __name__ == "__main__":
    asyncio.run(serve())
