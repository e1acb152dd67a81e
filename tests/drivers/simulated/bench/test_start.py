"""Starting a simulated bench as a process of its own: what happens where there is nothing to be."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from drivers.shared.visa_link import VisaLink
from drivers.simulated.bench import start as simulated
from rig.core.clock import ControlLink, SlavedClock
from rig.core.errors import ConfigurationError

PATIENCE_S = 30.0


def test_a_bench_whose_owner_dies_before_it_gives_options_ends() -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "drivers.simulated.bench.process"],
        input=b"",
        capture_output=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"", b"")


def test_no_process_is_started_for_a_fault_plan_that_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[object] = []
    monkeypatch.setattr(simulated.subprocess, "Popen", lambda *a, **k: started.append(a))
    plan = tmp_path / "fault.toml"
    plan.write_text('[[fault]]\ndevice = "kettle"\nkind = "stuck"\n')
    with pytest.raises(ConfigurationError, match="kettle"):
        simulated.start({"fault": str(plan), "results": str(tmp_path)})
    assert started == []


def processor_time_s(pid: int) -> float:
    """Processor time of a process so far, in s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_a_long_record_is_computed_while_its_time_passes_and_not_while_the_link_waits(
    tmp_path: Path,
) -> None:
    bench = simulated.start({"results": str(tmp_path)})
    ready = bench.ready()
    clock = SlavedClock(ControlLink(ready["control_port"]))
    table = tomllib.loads(ready["bench_toml"])["daq"]
    link = VisaLink("daq", table["resource"], PATIENCE_S, clock)
    try:
        link.command("ROUT:SCAN (@101,102)", "ACQ:SRAT 64000", "ACQ:POIN 640000", "DIG")
        begun_s = processor_time_s(bench.pid)
        clock.sleep(10.1)
        passed_s = processor_time_s(bench.pid)
        content = link.query_block("WAV:DATA?", 2 * 2 * 640_000)
        read_s = processor_time_s(bench.pid)
    finally:
        link.close()
        clock.close()
        bench.wait()
    assert len(content) == 2 * 2 * 640_000
    assert read_s - passed_s < 0.25 * (read_s - begun_s)


def test_a_log_that_cannot_be_written_is_an_error_of_the_option(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "world.log"
    bench = simulated.start({"world_log": str(path)})
    try:
        with pytest.raises(
            ConfigurationError, match=f"{path}: No such file or directory"
        ) as raised:
            bench.ready()
        assert raised.value.hint is not None
        assert "--world-log" in raised.value.hint
    finally:
        bench.wait()
