"""From an overload to the command on the wire, in real time, idle and inside a blocking read.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_trip.py``; `RIG_REPEATS=4` for four
runs idle and three in a blocking read instead of 16 and 12.
"""

from __future__ import annotations

import signal

import numpy as np
import pytest
from measured import heading, repeats, row

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3000)]


@pytest.mark.parametrize("blocked", [False, True], ids=["idle", "in a blocking read"])
def test_from_overload_to_the_command_on_the_wire(rig, blocked):
    """In real time; the World's log says when the force rose and when the generator obeyed."""
    heading(f"rig sweep in real time, a push of 30 N, procedure {'blocked' if blocked else 'idle'}")
    pushed = range(4, 401, 4 if not blocked else 400)
    plan = "".join(
        f'[[fault]]\ndevice = "force_sensor"\nkind = "spike"\nacquisition = {k}\nafter_s = 0.3\n'
        for k in pushed
    )
    if blocked:
        plan += '[[fault]]\ndevice = "daq"\nkind = "silence"\nat = 4\ncommand = "WAV:DATA"\n'
    delays: list[float] = []
    runs = max(1, repeats(16) * 3 // 4) if blocked else repeats(16)
    for repeat in range(runs):
        before = len(delays)
        path = rig.folder / f"{blocked}{repeat}.toml"
        rig.world_log.unlink(missing_ok=True)
        serving = rig.start(
            "simulate", "--write", str(path), "--world-log", str(rig.world_log),
            "--fault", rig.fault(plan),
        )  # fmt: skip
        serving.wait_for("Ctrl-C ends it")
        path.write_text(path.read_text().replace("timeout_ms = 2000", "timeout_ms = 5000"))
        ended = rig.run("sweep", "--bench", str(path), "--no-figures", "--frequencies", "2,3,300")
        serving.send(signal.SIGINT)
        serving.finish()
        log = rig.log()
        for begin_us in (x["t_us"] for x in log if x["value"] == "spike"):
            off = [
                x["t_us"] for x in log
                if x["what"] == "ch1.on" and not x["value"] and x["t_us"] >= begin_us
            ]  # fmt: skip
            on_before = [x for x in log if x["what"] == "ch1.on" and x["t_us"] < begin_us]
            if off and on_before and on_before[-1]["value"]:
                delays.append((off[0] - begin_us) * 1e-3)
        found = ", ".join(f"{delay_ms:.2f}" for delay_ms in delays[before:])
        # Each of them is a trip that the run reports, not the end of a point or of the run.
        assert len(delays) - before == ended.stderr.count("is over the limit"), ended.stderr
        print(f"run {repeat + 1} of {runs}: {found or 'no trip'} ms", flush=True)
    row("overload to generator off", delays, "ms", 2)
    p50, p99 = np.quantile(delays, [0.5, 0.99])
    print(f"p50 {p50:.2f} ms, p99 {p99:.2f} ms, largest {max(delays):.2f} ms (n = {len(delays)})")
