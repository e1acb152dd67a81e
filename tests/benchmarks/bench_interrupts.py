"""A sweep interrupted at random instants of its whole life, from its first import to its last line.

SIGINT, then resume: every point once, values as if nothing had happened, output off. kill -9: the
guard or `rig recover` makes a valid file of everything that had reached the journal, output off.
The journal is read here by a few lines of its own, so that what was acknowledged is not found by
the code that is on trial.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_interrupts.py``; `RIG_REPEATS=10`
for ten instants instead of fifty.
"""

from __future__ import annotations

import collections
import contextlib
import json
import math
import random
import signal
import struct
import time
import zlib

import h5py
import numpy as np
import pytest
from measured import heading, repeats, row

from rig.analysis.film.frequency_plan import FrequencyPlanSettings, scan_frequencies_Hz
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(2400)]

INSTANTS = repeats(50)
GRID = scan_frequencies_Hz(FrequencyPlanSettings())[21::3]
POINT_S = 0.06
"""About a point's wall time on the slaved bench."""
SWEEP = ("--frequencies", ",".join(f"{frequency:g}" for frequency in GRID))
GUARD_PATIENCE_S = 15.0
LARGEST_DIFFERENCE = 4.5 * math.sqrt(2)
"""Combined stated errors. A resumed point has the noise of the uninterrupted run's, but the tone
another phase; at the opposite phase the noise's share changes its sign, so that the two errors do
not add as independent ones would but double."""


def fresh(rig, name):
    """The command line in a folder of its own."""
    folder = rig.folder / name
    folder.mkdir()
    return type(rig)(folder)


def outputs(path):
    """States of the generator's output in a World's log, in order."""
    lines = path.read_text().splitlines() if path.exists() else []
    entries = [json.loads(line) for line in lines]
    return [entry["value"] for entry in entries if entry["what"] == "ch1.on"]


def is_off(states):
    return not states or states[-1] is False


class Instants:
    """Random instants of a run's life: its start-up, its points, and what follows the last."""

    STARTING, FINISHING = round(0.24 * INSTANTS), round(0.2 * INSTANTS)

    def __init__(self, seed, starting_s, finishing_s):
        self._draw = random.Random(seed)
        self._starting_s, self._finishing_s = starting_s, finishing_s

    def await_instant(self, number, running):
        """Wait for one of the INSTANTS; gives its name."""
        share = self._draw.random()
        if number < self.STARTING:
            delay_s = (number + share) / self.STARTING * self._starting_s
            time.sleep(delay_s)
            return f"{delay_s:.3f} s after the start"
        if number >= INSTANTS - self.FINISHING:
            running.wait_for(rf"^{len(GRID)}/")
            delay_s = share * self._finishing_s
            time.sleep(delay_s)
            return f"{delay_s:.3f} s after the last point"
        point = self._draw.randrange(len(GRID))
        running.wait_for(rf"^{point}/" if point else "points, about")
        time.sleep(share * POINT_S)
        return f"{share * POINT_S:.3f} s after point {point}"


def uninterrupted(rig, seed):
    """A whole sweep's columns, and the instants drawn from how long its parts take."""
    walls, starting, finishing = [], [], []
    for k in range(3):
        here = fresh(rig, f"whole-{k}")
        start = time.perf_counter()
        running = here.start_sweep(*SWEEP)
        running.wait_for("points, about")
        begun = time.perf_counter()
        running.wait_for(rf"^{len(GRID)}/")
        last = time.perf_counter()
        ended = running.finish()
        end = time.perf_counter()
        walls.append(end - start)
        starting.append(begun - start)
        finishing.append(end - last)
        assert ended.code == 0, ended.stderr
        here.close()
    row("uninterrupted sweep", walls, "s", 2)
    made = Instants(seed, row("its start-up", starting, "s", 2), row("its end", finishing, "s", 2))
    return columns(here.only("*.h5")), made


def columns(file):
    """Point ids, complex response, variances of its parts, gain and its error."""
    with RunFile.open(file) as run:
        assert run.outcome.status == "complete"
        response = run.column("response_real"), run.column("response_imag")
        variances = run.column("response_var_real"), run.column("response_var_imag")
        gain = run.column("gain"), run.column("gain_error")
        return run.point_ids(), np.stack(response), np.stack(variances), gain


def differences(got, expected):
    """Real and imaginary parts and gain less the uninterrupted run's, in combined stated errors."""
    parts = (got[1] - expected[1]) / np.sqrt(got[2] + expected[2])
    gain = (got[3][0] - expected[3][0]) / np.hypot(got[3][1], expected[3][1])
    return np.concatenate([parts.ravel(), gain])


def test_interrupt_and_resume(rig):
    heading(f"rig sweep ({len(GRID)} points), SIGINT at {INSTANTS} instants, rig resume")
    expected, drawn = uninterrupted(rig, 1)
    endings, found, problems, seen = collections.Counter(), [], [], []
    to_end = []
    for k in range(INSTANTS):
        here = fresh(rig, f"int-{k}")
        running = here.start_sweep(*SWEEP)
        where = drawn.await_instant(k, running)
        sent = time.perf_counter()
        running.send(signal.SIGINT)
        ended = running.finish()
        to_end.append(time.perf_counter() - sent)
        where = f"SIGINT {where}: exit {ended.code}"
        if not is_off(outputs(here.world_log)):
            problems.append(f"{where}: output left on")
        if "Traceback" in ended.stderr:
            seen.append(f"{where}, traceback: {ended.stderr.strip().splitlines()[-1]}")
        journals, files = list(here.results.rglob("*.rigj")), list(here.results.rglob("*.h5"))
        kind = "resumed" if journals else "ran to its end" if files else "had not begun"
        endings[kind, ended.code] += 1
        if journals:
            if ended.code != 130 or not files or verify(files[0]):
                problems.append(f"{where}: files {files}, {ended.stderr[-300:]}")
            log = here.folder / "resumed.jsonl"
            arguments = ("--no-figures", "--json", "--world-log", str(log))
            resumed = here.run("resume", str(journals[0]), *arguments)
            if resumed.code != 0:
                problems.append(f"{where}: resume gave {resumed.code}: {resumed.stderr[-300:]}")
                continue
            if not is_off(outputs(log)):
                problems.append(f"{where}: output left on after resume")
            files = list(here.results.rglob("*.h5"))
        if files:
            got = columns(files[0])
            if got[0] != expected[0] or len(set(got[0])) != len(GRID):
                problems.append(f"{where}: point ids differ")
            elif verify(files[0]):
                problems.append(f"{where}: {verify(files[0])}")
            else:
                found.append(differences(got, expected))
        here.close()
    for (kind, code), count in sorted(endings.items()):
        print(f"{count:3d} of {INSTANTS}: {kind}, exit {code}")
    row("from signal to the end of the process", to_end, "s", 2)
    every = np.concatenate(found)
    print(
        f"{len(found)} complete files, every id once: difference from the uninterrupted run in "
        f"combined stated errors: largest {np.abs(every).max():.3f}, "
        f"rms {np.sqrt((every**2).mean()):.3f}; {(every == 0).mean():.0%} bitwise equal"
    )
    print("\n".join([*seen, *problems]))
    assert not problems
    assert np.abs(every).max() < LARGEST_DIFFERENCE


def read_journal(data):
    """Samples by (attempt, first row), each as raw bytes joined, and ids of kept points.

    An own reading of the format: magic, then records of u32 length, u32 crc32, payload; a payload
    is a kind and its body. It ends at the first torn or damaged record.
    """
    assert data[:8] == b"RIGJ0001"
    at, attempt, count, kept = 8, None, 0, []
    samples, open_key = {}, None
    while at + 8 <= len(data):
        length, checksum = struct.unpack_from("<II", data, at)
        payload = data[at + 8 : at + 8 + length]
        if len(payload) < length or zlib.crc32(payload) != checksum:
            break
        at += 8 + length
        kind = payload[0]
        if kind == 2:
            _, _, first, _ = struct.unpack_from("<BHQd", payload)
            if open_key is None or open_key[0] != attempt:
                open_key = (attempt, first)
            samples[open_key] = samples.get(open_key, b"") + payload[19:]
        elif kind == 4:
            attempt, count, open_key = count, count + 1, None
        elif kind in (5, 6, 7):
            if kind == 5:
                kept.append(json.loads(payload[1:])["id"])
            attempt, open_key = None, None
    return samples, kept


def read_file(file):
    """The same from a run file: its channels put side by side again."""
    samples = {}
    with h5py.File(file) as opened:
        entry = opened["entry"]
        for place in ("waveforms", "discarded", "between_points"):
            for data in entry[place].values() if place in entry else ():
                names = [data.attrs["signal"], *data.attrs.get("auxiliary_signals", ())]
                rows = np.stack([data[name][()] for name in names], axis=1)
                attempt = data.attrs.get("attempt")
                key = (None if attempt is None else int(attempt), int(data.attrs["first_index"]))
                samples[key] = rows.astype("<i2").tobytes()
        kept = [value.decode() for value in entry["points/id"][()]]
    return samples, kept


def seconds_to_off(path):
    """From the owner's end to the output's, in the World's time, which is then real."""
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    gone = [entry["t_us"] for entry in entries if entry["what"] == "owner-gone"]
    off = [e["t_us"] for e in entries if e["what"] == "ch1.on" and e["value"] is False]
    return (off[-1] - gone[0]) * 1e-6 if gone and off and off[-1] > gone[0] else None


def compare(where, journal, file):
    """What of a journal's bytes a run file lacks."""
    samples, kept = read_journal(journal)
    got, got_kept = read_file(file)
    problems = [
        f"{where}: attempt {attempt}, row {first}: samples differ or are missing"
        for (attempt, first), rows in samples.items()
        if got.get((attempt, first)) != rows
    ]
    if sorted(got_kept) != sorted(kept):
        problems.append(f"{where}: kept points differ: {sorted(set(kept) ^ set(got_kept))[:5]}")
    return problems, sum(map(len, samples.values())) // 4


def test_kill(rig):
    heading(f"rig sweep ({len(GRID)} points), kill -9 at {INSTANTS} instants, guard, rig recover")
    _, drawn = uninterrupted(rig, 2)
    endings, problems, notes = collections.Counter(), [], []
    offs, behind, compared = [], [], 0
    for k in range(INSTANTS):
        here = fresh(rig, f"kill-{k}")
        running = here.start_sweep(*SWEEP)
        where = f"kill -9 {drawn.await_instant(k, running)}"
        journals = list(here.results.rglob("*.rigj"))
        before = b""
        with contextlib.suppress(FileNotFoundError):  # a complete run has just retired it
            before = journals[0].read_bytes() if journals else b""
        running.send(signal.SIGKILL)
        ended = running.finish()
        journals, files = list(here.results.rglob("*.rigj")), list(here.results.rglob("*.h5"))
        if ended.code == 0:
            endings["ended before the kill"] += 1
        elif not journals and not files:
            endings["had not begun a journal"] += 1
        elif not journals and not before:
            endings["its file was complete"] += 1
            problems += [f"{where}: verify: {finding}" for finding in verify(files[0])]
            if len(columns(files[0])[0]) != len(GRID):
                problems.append(f"{where}: points are missing")
        else:
            report = here.guard_report()
            journals = list(here.results.rglob("*.rigj"))
            endings["guard reported" if report else "no guard reported"] += 1
            if report and not report["safe"]:
                problems.append(f"{where}: guard: {report['failures']}")
            if report and report["file"].startswith("not compiled"):
                notes.append(f"{where}: guard says {report['file']}")
            after = journals[0].read_bytes() if journals else before
            if not after.startswith(before):
                problems.append(f"{where}: the journal lost what it had")
            if journals:
                recovered = here.run("recover", str(journals[0]))
                if recovered.code != 0:
                    problems.append(f"{where}: recover {recovered.code}: {recovered.stderr[-300:]}")
            files = list(here.results.rglob("*.h5"))
            if not files:
                problems.append(f"{where}: no file")
            else:
                problems += [f"{where}: verify: {finding}" for finding in verify(files[0])]
                found, samples = compare(where, after, files[0])
                problems += found
                compared += samples
                said = sum(1 for line in ended.stderr.splitlines() if f"/{len(GRID)} " in line)
                behind.append(said - len(read_journal(after)[1]))
        deadline = time.monotonic() + GUARD_PATIENCE_S
        while not is_off(outputs(here.world_log)) and time.monotonic() < deadline:
            time.sleep(0.05)
        if not is_off(outputs(here.world_log)):
            problems.append(f"{where}: output left on")
        elif here.world_log.exists() and (delay := seconds_to_off(here.world_log)) is not None:
            offs.append(delay)
        here.close()
    for kind, count in sorted(endings.items()):
        print(f"{count:3d} of {INSTANTS}: {kind}")
    print(f"{compared} rows of two channels compared with the journals, byte by byte")
    if offs:
        row("from the kill to output off", offs, "s", 2)
    row("points shown as kept but not yet written", behind, "", 0)
    print("\n".join([*notes, *problems]))
    assert not problems
