"""The night of bench_batch_night.py with a disk that fills up and a change of summer time in it:
eight hours of bench time, one command, faults in 30 % of the runs, nobody lost, doubled or unsafe,
nothing later than `stop_by`.

    ./run python tests/benchmarks/bench_hard_night.py      RIG_RUNS=330 RIG_HOURS=8 RIG_DISK_MB=4000
    RIG_RUNS=60 RIG_HOURS=0.2 RIG_FULL_AT=3 RIG_FIGURES=0 \\
        ./run python tests/benchmarks/bench_hard_night.py

The results lie on a small file system of their own (tmpfs; root is needed to mount it). At run
RIG_FULL_AT (a third of them) something else takes all its room, until the batch is on hold and
`rig batch status` has said why. The logs of the simulated benches lie elsewhere: a bench of metal
needs no disk. Half-way through the night the clock of the batch's zone goes an hour ahead;
`stop_by` is RIG_HOURS of real time after the beginning. Whoever looks at the bench at other holds
is played as in bench_batch_night.py.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import tempfile
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

from benchmarks.bench_batch_night import RIG, RUNS, injected, night_toml, simulation, wrong
from benchmarks.measured import machine
from nights import ask, folder_of

HOURS = float(os.environ.get("RIG_HOURS", "8"))
DISK_MB = int(os.environ.get("RIG_DISK_MB", "4000"))
FULL_AT = int(os.environ.get("RIG_FULL_AT", str(RUNS // 3)))
FULL_S = 20.0
"""Wall time for which the disk stays full once the batch is on hold."""


def zone(changes: datetime) -> str:
    """A POSIX zone whose clock goes from UTC to UTC+1 at this instant, and back in 90 days."""
    back = changes + timedelta(days=90, hours=1)
    first, last = (f"{day.timetuple().tm_yday - 1}/{day:%H:%M:%S}" for day in (changes, back))
    return f"WINTER0SUMMER-1,{first},{last}"


def fill(folder: Path) -> Path:
    """A file that takes all room that is left."""
    path = folder / "filler"
    with path.open("ab", buffering=0) as file:
        for size in (1 << 20, 1 << 12, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(bytes(size))
    return path


class Night:
    """One batch in a folder, with the persons and the disk around it."""

    def __init__(self, folder: Path, environment: dict[str, str]):
        self._folder, self._environment = folder, environment
        self._filler: Path | None = None
        self.filled = False
        self.disk_holds = self.other_holds = 0
        self.codes: list[int] = []

    def take(self) -> None:
        """Run the batch to its `stop_by`, or to its end, starting it again where it has ended."""
        arguments = ["run", "night.toml"]
        while True:
            process = subprocess.Popen(
                [*RIG, "batch", *arguments],
                cwd=self._folder,
                env=self._environment,
                stderr=subprocess.PIPE,
                text=True,
            )
            assert process.stderr is not None
            for line in process.stderr:
                print(line, end="", flush=True)
                self._react(line)
            self.codes.append(process.wait())
            batch = folder_of(self._folder / "results")
            left = ask(batch, "SELECT 1 FROM run WHERE state = 'queued'")
            if self.codes[-1] == 6 or not left or len(self.codes) > 20:
                return
            arguments = ["resume"]

    def _react(self, line: str) -> None:
        if line.startswith("batch results/"):
            self._keep_world_logs_elsewhere()
        elif line.startswith(f"run {FULL_AT}/") and not self.filled:
            self._filler, self.filled = fill(self._folder / "results"), True
        elif "it continues when there is room" in line:
            self.disk_holds += 1
            if self._filler is not None:
                print(self._rig("status").splitlines()[0], flush=True)
                time.sleep(FULL_S)
                self._filler.unlink()
                self._filler = None
        elif "the bench is safe and the batch waits" in line:
            self.other_holds += 1
            self._rig("resume")

    def _keep_world_logs_elsewhere(self) -> None:
        elsewhere = self._folder / "worlds"
        elsewhere.mkdir()
        runs = folder_of(self._folder / "results") / "runs"
        for number in range(1, 2 * RUNS):
            name = f"r{number:05d}.world.jsonl"
            (runs / name).symlink_to(elsewhere / name)

    def _rig(self, command: str) -> str:
        made = subprocess.run(
            [*RIG, "batch", command],
            cwd=self._folder,
            env=self._environment,
            capture_output=True,
            text=True,
            check=True,
        )
        return made.stdout


def main() -> None:
    """Take a night and tell what came of it."""
    print(machine())
    folder = Path(tempfile.mkdtemp(prefix="rig-hard-night-"))
    results = folder / "results"
    results.mkdir()
    mount = ("mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(results))
    subprocess.run(mount, check=True)
    begun = datetime.now(UTC).replace(microsecond=0)
    stop_by = begun + timedelta(hours=HOURS)
    by_the_clock = stop_by + timedelta(hours=1)  # summer time by then
    text = night_toml(simulation(folder)).replace(
        'name = "night"', f'name = "night"\nstop_by = {by_the_clock:%H:%M:%S}', 1
    )
    text = text.replace("consecutive_failures = 3", "consecutive_failures = 3, free_disk_GB = 0")
    (folder / "night.toml").write_text(text)
    changes = begun + timedelta(hours=HOURS / 2)
    print(f"folder {folder}; the clock goes an hour ahead at {changes:%H:%M:%S} UTC")
    night, wall_s = Night(folder, {**os.environ, "TZ": zone(changes)}), time.monotonic()
    try:
        night.take()
        judge(night, folder_of(results), begun, stop_by, time.monotonic() - wall_s)
    finally:
        subprocess.run(("umount", "-l", str(results)), check=False)


def judge(night: Night, batch: Path, begun: datetime, stop_by: datetime, wall_s: float) -> None:
    """Print what the night did, and everything that it may not have done."""
    for log in (batch / "runs").glob("*.world.jsonl"):
        if not log.exists():  # the log of a run that was not begun
            log.unlink()
    ((passed_s,),) = ask(batch, "SELECT value FROM meta WHERE key = 'night_s'")
    states = dict(ask(batch, "SELECT state, count(*) FROM run GROUP BY state"))
    over = begun + timedelta(seconds=float(passed_s))
    print(f"runs {states}, exit codes {night.codes}, wall time {wall_s / 60:.1f} min")
    print(f"bench time {float(passed_s) / 3600:.2f} h: over at {over:%H:%M:%S} UTC")
    print(f"holds: by the disk {night.disk_holds}, others let go {night.other_holds}")
    counts = dict(ask(batch, "SELECT key, value FROM meta WHERE key IN ('holds', 'presses')"))
    print(f"of the runs: {counts}")
    print(f"faults injected {injected(batch).total()}")
    queued = {number for (number,) in ask(batch, "SELECT number FROM run WHERE state = 'queued'")}
    of_queued = {f"run {n} is queued" for n in queued}
    of_queued |= {f"nothing was made of run {n}" for n in queued}
    breaches = [one for one in wrong(batch) if night.codes[-1] != 6 or one not in of_queued]
    if over > stop_by:
        breaches.append(f"the night was over at {over}, stop_by is {stop_by}")
    if not night.disk_holds:
        breaches.append("the full disk was not noticed")
    print(f"lost, doubled, unsafe, unsound or late: {len(breaches)}")
    for breach in breaches:
        print(f"  {breach}")


if __name__ == "__main__":
    main()
