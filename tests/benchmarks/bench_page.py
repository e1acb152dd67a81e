"""What the page costs, and how soon it shows and stops. One command measures each figure:

    ./run pytest -m benchmark -n 0 -s tests/benchmarks/bench_page.py -k screen

``-k screen``   from a sample to the screen and to a client that only reads
``-k click``    from a click on STOP to the output off on the wire, to the END record and the screen
``-k ticks``    late ticks without a page, with a client that reads, with a browser, alternating
``-k viewers``  memory and delay with ten viewers, two of which never read
``-k extra``    installed size of the extra
``-k night``    memory over a night in virtual time

Delays and ticks are measured alone on the computer. `RIG_REPEATS` is the number of seconds of
``screen``, of clicks, of rounds of ``ticks`` and of hours of ``night``. Browser, server, run and
simulated bench share the processors of one computer: a real bench computer has no simulated bench
to carry.
"""

from __future__ import annotations

import http.client
import itertools
import json
import random
import re
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.metadata import PackageNotFoundError, distribution
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recorded_run
from chromium import chromium
from measured import heading, repeats, row
from nights import ask, folder_of
from test_server import Page, serve

import rig.page
from rig.files.journal.follow import JournalTail
from rig.files.journal.recorder import Recorder
from rig.files.journal.values import End
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.reader import RunFile

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(7200)]

SAMPLE_S = 0.01
"""Interval of the samples that hold the time at which they were recorded."""
ROWS_A_SAMPLE = 10
STAMPED = {
    "streams": [
        {"name": "force", "device": "", "channels": ["F_n"], "dtype": "<f8", "row_shape": [1]},
        {"name": "signals", "device": "", "channels": ["v_d", "v_1", "v_2"], "dtype": "<f8",
         "row_shape": [3]},
    ],
    "settings": {},
}  # fmt: skip
"""A run's usual traffic: a slow stream, and strips at 1 kHz."""


def record_stamps(path: Path, begin_s: float) -> None:
    """Record samples whose value is the time since `begin_s` (of `time.time`), until killed."""
    writer = JournalWriter.create(path, recorded_run.header(**STAMPED))
    recorder = Recorder(writer)
    for stream, channels, rate_Hz, units in ((0, 1, 100.0, "N"), (1, 3, 1000.0, "V")):
        recorder.put_stream(
            {"stream": stream, "rate_Hz": rate_Hz, "scale": [1.0] * channels,
             "offset": [0.0] * channels, "units": units}
        )  # fmt: skip
    recorder.put_point_begin(recorded_run.POINTS[0], {"time": 0.0})
    chance = np.random.default_rng(1)
    for n in range(10**9):
        time.sleep(max(0.0, begin_s + n * SAMPLE_S - time.time()))
        now_s = time.time() - begin_s
        recorder.put_block(0, n, now_s, np.array([[now_s]]))
        strips = 1e-3 * chance.standard_normal((ROWS_A_SAMPLE, 3))
        recorder.put_block(1, ROWS_A_SAMPLE * n, now_s, strips)


@contextmanager
def stamping(results: Path) -> Iterator[float]:
    """Have a process record stamps; give the time that they count from."""
    path = results / "2026-11-21" / "2026-11-21T22-00-00_sweep_r001.rigj"
    path.parent.mkdir(parents=True, exist_ok=True)
    begin_s = time.time()
    run = get_context("spawn").Process(target=record_stamps, args=(path, begin_s))
    run.start()
    try:
        yield begin_s
    finally:
        run.kill()
        run.join()


@contextmanager
def served(results: Path) -> Iterator[tuple[Any, Page]]:
    """A page, its process and its address."""
    results.mkdir(exist_ok=True)
    process, page = serve(results)
    try:
        yield process, page
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(60)


class Viewer(threading.Thread):
    """A client that reads the stream, and remembers when which latest sample came."""

    def __init__(self, page: Page, begin_s: float = 0.0):
        super().__init__(daemon=True)
        self._page, self._begin_s = page, begin_s
        self.over = threading.Event()
        self.shown: list[tuple[float, float]] = []
        """Time of each frame and value of its latest sample, both in s since `begin_s`."""
        self.bytes = 0

    def run(self) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self._page.port, timeout=60)
        with closing(connection):
            connection.request("GET", "/api/live", headers=self._page.bearer())
            answer = connection.getresponse()
            while not self.over.is_set():
                line = answer.readline()
                now_s = time.time() - self._begin_s
                self.bytes += len(line)
                if self._begin_s and line.startswith(b"data: "):
                    streams = json.loads(line[6:])["run"].get("streams", {})
                    if latest := streams.get("force", {}).get("latest"):
                        self.shown.append((now_s, latest[0]))


def delays_ms(shown: list[tuple[float, float]]) -> np.ndarray:
    """Return for each sample how long after it was recorded the first frame with it was shown."""
    found = []
    for (_, before), (at_s, latest) in itertools.pairwise(shown):
        found += [at_s - stamp for stamp in np.arange(latest, before, -SAMPLE_S)]
    return 1e3 * np.array(found)


def tell(name: str, delays: np.ndarray) -> None:
    """Print a spread with its 99th percentile."""
    row(name, list(delays), "ms", 0)
    print(f"{'':44s} 99th percentile {np.quantile(delays, 0.99):.0f} ms")


WATCH_FRAMES = """
window.shownAt = [];
const plain = take, begin = arguments[0];
window.take = frame => {
  plain(frame);
  const value = frame.run.streams?.force?.latest[0];
  if (value !== undefined) requestAnimationFrame(() => setTimeout(() => // it has been painted
    shownAt.push([(performance.timeOrigin + performance.now()) / 1e3 - begin, value])));
};
"""


def test_from_a_sample_to_the_screen(rig, tmp_path):
    lasts_s = repeats(60)
    heading(f"samples every {1e3 * SAMPLE_S:g} ms for {lasts_s} s, 5 frames/s, one viewer a time")
    with stamping(rig.results) as begin_s, served(rig.results) as (_, page):
        viewer = Viewer(page, begin_s)
        viewer.start()
        time.sleep(2 + lasts_s)
        viewer.over.set()
        viewer.join()
        tell("recorded to received by a client", delays_ms(viewer.shown[10:]))
        with chromium(tmp_path / "profile") as browser:
            browser.get(f"http://127.0.0.1:{page.port}/#token={page.watch_token}")
            time.sleep(2)
            browser.execute_script(WATCH_FRAMES, begin_s)
            time.sleep(lasts_s)
            shown = browser.execute_script("return shownAt")
        tell("recorded to painted by the browser", delays_ms(shown))


WATCH_STOP = """
window.clickedAt = window.endedAt = null;
const now = () => (performance.timeOrigin + performance.now()) / 1e3;
document.getElementById("stop").addEventListener("click", () => clickedAt = now(), true);
new MutationObserver(() => {
  if (clickedAt && !endedAt && document.getElementById("course-phase").textContent === "ended")
    requestAnimationFrame(() => setTimeout(() => endedAt ||= now()));
}).observe(document.getElementById("course-phase"), {childList: true});
"""


def test_from_a_click_to_the_output_off_and_to_the_end(rig, tmp_path):
    clicks = repeats(50)
    heading(f"{clicks} sweeps in real time, STOP clicked while the generator is on")
    bench, chance = rig.folder / "bench.toml", random.Random(1)
    serving = rig.start("simulate", "--write", str(bench), "--world-log", str(rig.world_log))
    serving.wait_for("in real time")
    given = ("sweep", "--bench", str(bench), "--json", "--no-figures", "--settling", "60s",
             "--frequencies", "200")  # fmt: skip
    offs, ends, screens = [], [], []
    with served(rig.results) as (_, page), chromium(tmp_path / "profile") as browser:
        browser.get(f"http://127.0.0.1:{page.port}/#token={page.stop_token}")
        for n in range(clicks):
            running = rig.start(*given)
            rig.await_world("ch1.on", True, n + 1)
            journal = max(rig.results.rglob("*.rigj"), key=lambda path: path.stat().st_mtime_ns)
            time.sleep(1.0 + chance.random())
            browser.execute_script(WATCH_STOP)
            browser.execute_script("setTimeout(() => document.getElementById('stop').click(), 50)")
            off_s, end_s = _off_and_end(rig, journal, n + 1)
            assert running.finish().code == 143
            while not (ended_s := browser.execute_script("return endedAt")):
                time.sleep(0.02)
            clicked_s = browser.execute_script("return clickedAt")
            offs.append(1e3 * (off_s - clicked_s))
            ends.append(1e3 * (end_s - clicked_s))
            screens.append(1e3 * (ended_s - clicked_s))
            print(
                f"click {n + 1}: off {offs[-1]:.0f} ms, END {ends[-1]:.0f} ms, "
                f"screen {screens[-1]:.0f} ms",
                flush=True,
            )
            browser.refresh()  # the token is kept; a page without observers
            time.sleep(0.5)
    serving.send(signal.SIGINT)
    serving.finish()
    for name, found in (("generator off on the wire", offs), ("END record in the journal", ends),
                        ("'ended' on the screen", screens)):  # fmt: skip
        tell(f"click to {name}", np.array(found))


def _off_and_end(rig: Any, journal: Path, count: int) -> tuple[float, float]:
    """Return when the World's log has the output off for the time `count`, and when the journal
    has its END; seen to within 2 ms."""
    off_s = end_s = 0.0
    with JournalTail(journal) as tail, rig.world_log.open() as log:
        text = ""
        while not (off_s and end_s):
            text += log.read()
            if not off_s:
                offs = re.findall(r'"ch1.on", "value": false', text)
                off_s = time.time() if len(offs) >= count else 0.0
            if not end_s and any(isinstance(record, End) for record in tail.poll()):
                end_s = time.time()
            time.sleep(0.001)
    return off_s, end_s


VARIANTS = ("no page", "page, a client that reads", "page, a browser here")


def test_late_ticks_beside_a_page(rig, tmp_path):
    rounds = repeats(5)
    heading(f"slip trials at 500 Hz in real time, {rounds} rounds of {len(VARIANTS)} variants")
    bench = rig.folder / "bench.toml"
    serving = rig.start("simulate", "--fixture", "plate", "--write", str(bench))
    serving.wait_for("in real time")
    late: dict[str, list[tuple[int, int]]] = {name: [] for name in VARIANTS}
    for n in range(rounds):
        for variant in VARIANTS[n % 3 :] + VARIANTS[: n % 3]:
            results = tmp_path / f"{n}-{variant[-6:].strip()}"
            if (found := _late_ticks(rig, results, bench, variant)) is not None:
                late[variant].append(found)
                print(f"{variant}: {found[1]} of {found[0]} ticks late", flush=True)
    serving.send(signal.SIGINT)
    serving.finish()
    for variant, found in late.items():
        ticks, share = sum(t for t, _ in found), [100 * few / t for t, few in found]
        all_late = sum(few for _, few in found)
        print(f"{variant}: {all_late} of {ticks} ticks late, {100 * all_late / ticks:.2f} %")
        row(f"{variant}: late ticks of a trial", share, "%", 2)


def _late_ticks(rig: Any, results: Path, bench: Path, variant: str) -> tuple[int, int] | None:
    """Take a trial with this variant beside it; return its ticks and how many were late. None
    where the computer was too slow for the trial."""

    def trial() -> tuple[int, int] | None:
        ended = rig.run(
            "slip-trial", "--bench", str(bench), "--results", str(results), "--tick", "500",
            "--distance", "2mm", "--json", "--no-figures",
        )  # fmt: skip
        with RunFile.open(next(results.rglob("*.h5"))) as file:
            readings = list(file.readings())
        if ended.code not in (0, 5) or not readings:
            print(f"{variant}: {'; '.join(ended.errors)}", flush=True)
            return None
        (reading,) = readings
        return int(reading["ticks"]), int(reading["late_ticks"])

    if variant == VARIANTS[0]:
        return trial()
    with served(results) as (_, page):
        if variant == VARIANTS[1]:
            viewer = Viewer(page)
            viewer.start()
            found = trial()
            viewer.over.set()
            return found
        with chromium(results.with_name(results.name + "-profile")) as browser:
            browser.get(f"http://127.0.0.1:{page.port}/#token={page.watch_token}")
            return trial()


def memory_MiB(pid: int) -> float:  # noqa: N802 - the unit keeps its capitals
    """Return the resident memory of a process."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(re.findall(r"VmRSS:\s+(\d+)", text)[0]) / 1024


def test_ten_viewers_two_of_which_never_read(rig):
    lasts_s = repeats(60)
    heading(f"ten viewers for {lasts_s} s, two of which never read")
    with stamping(rig.results) as begin_s, served(rig.results) as (process, page):
        first = Viewer(page, begin_s)
        first.start()
        time.sleep(lasts_s / 2)
        before, alone = memory_MiB(process.pid), delays_ms(first.shown[10:])
        idle = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(2)]
        for viewer in idle:
            viewer.sendall(
                b"GET /api/live HTTP/1.1\r\nHost: localhost\r\n"
                b"Authorization: Bearer %s\r\n\r\n" % page.watch_token.encode()
            )
        others = [Viewer(page) for _ in range(7)]
        for other in others:
            other.start()
        shown, memory = len(first.shown), []
        for _ in range(10):
            time.sleep(lasts_s / 10)
            memory.append(memory_MiB(process.pid))
        tell("recorded to received, one viewer", alone)
        tell("recorded to received, beside nine others", delays_ms(first.shown[shown:]))
        print(f"memory of the server: one viewer {before:.1f} MiB; with ten, over time: "
              + ", ".join(f"{value:.1f}" for value in memory))  # fmt: skip
        for viewer in (first, *others):
            viewer.over.set()
        for end in idle:
            end.close()


def test_size_of_the_extra():
    heading("installed bytes of what tactile-rig[page] adds")
    own = distribution("tactile-rig")
    base = _needed(own.requires or [], "")
    added = _needed(own.requires or [], "page") - base
    sizes = {name: sum((file.locate().stat().st_size for file in distribution(name).files or []
                        if file.locate().is_file() and "__pycache__" not in file.parts), 0)
             for name in sorted(added)}  # fmt: skip
    for name, size in sizes.items():
        print(f"{name} {distribution(name).version}: {size / 1024:.0f} KiB")
    print(f"together: {sum(sizes.values()) / 1024:.0f} KiB")
    static = list((Path(rig.page.__file__).parent / "static").iterdir())
    print(f"rig/page/static, always there: {sum(f.stat().st_size for f in static) / 1024:.0f} KiB")


def _needed(requirements: list[str], extra: str) -> set[str]:
    """Return the names of the packages that these requirements need here, with those that they
    need in turn."""
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    found: set[str] = set()
    open_ones = [(Requirement(text), extra) for text in requirements]
    while open_ones:
        one, of_extra = open_ones.pop()
        if one.marker is not None and not one.marker.evaluate({"extra": of_extra}):
            continue
        name = canonicalize_name(one.name)
        if name not in found:
            try:
                inner = distribution(name).requires or []
            except PackageNotFoundError:
                continue
            found.add(name)
            open_ones += [(Requirement(text), "") for text in inner]
    return found


NIGHT = """
[batch]
name = "night"
figures = false
detect = false
order = "shuffled"

[[experiment]]
procedure = "sweep"
settings = { frequencies_Hz = [160, 180, 200, 220, 240], settling_s = 5 }
repeat = 1000
rest_s = 88

[[experiment]]
procedure = "slip-trial"
settings = { trials = 2 }
repeat = 300
rest_s = 88
"""


def test_memory_over_a_night(rig):
    hours = repeats(8)
    heading(f"a batch in virtual time until {hours} h of bench time, one viewer")
    (rig.folder / "night.toml").write_text(NIGHT)
    with served(rig.results) as (process, page):
        viewer = Viewer(page)
        viewer.start()
        night = rig.start("batch", "run", "night.toml", fresh=True)
        night.wait_for("1300")
        bench_h, rows, next_h = 0.0, [], 0.0
        while bench_h < hours:
            time.sleep(1)
            found = ask(folder_of(rig.results), "SELECT count(*), sum(bench_s) FROM run "
                        "WHERE state = 'done'")[0]  # fmt: skip
            bench_h = ((found[1] or 0.0) + 88 * found[0]) / 3600
            for path in ("/api/night", "/api/runs"):
                assert page.ask("GET", path, **page.bearer())[0] == 200
            if bench_h >= next_h:
                rows.append((bench_h, memory_MiB(process.pid)))
                print(f"{bench_h:5.2f} h, {found[0]} runs: {rows[-1][1]:.1f} MiB", flush=True)
                next_h += 0.5
        viewer.over.set()
        night.send(signal.SIGTERM)
        night.finish()
    at_h, memory = np.array([one for one in rows if one[0] >= 1.0]).T
    print(f"from 1 h on: {np.polyfit(at_h, memory, 1)[0]:+.2f} MiB an hour; the viewer took "
          f"{viewer.bytes / 2**20:.0f} MiB")  # fmt: skip
