"""One program at a time on an instrument, whoever it is and whatever became of the one before."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from rig.bench.addresses import addresses_of
from rig.bench.plan import BenchPlan, parse_bench
from rig.core.errors import ConfigurationError, ExitCode
from rig.core.settings import Address, Settings
from rig.run.locks import lock
from rig.run.locks.bench_mark import BenchMarks, clear_marks, read_marks
from rig.run.locks.lock import BenchLock, GuardWait, address_names, in_use
from rig.run.locks.shared_folder import user_name
from rig.run.stopping import StopRequestedError

BENCH = """
name = "{name}"
[fixture]
mounted = "film-clamp"
[generator]
driver = "keysight-33500b"
resource = "TCPIP0::127.0.0.1::{generator}::SOCKET"
max_amplitude_V = 5.0
[force_sensor]
driver = "me-gsv8"
port = "{port}"
"""

HOLDER = """
import sys
from pathlib import Path
from rig.bench.plan import read_bench
from rig.run.locks.lock import BenchLock
lock = BenchLock(read_bench(Path(sys.argv[1])))
lock.note_run(Path("/data/run.rigj"))
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder for locks of this test's own."""
    monkeypatch.setenv("RIG_SHARED_FOLDER", str(tmp_path / "shared"))


def plan(name: str = "b", generator: int = 5025, port: str = "/dev/ttyX") -> BenchPlan:
    return parse_bench(BENCH.format(name=name, generator=generator, port=port), "bench.toml")


def test_a_bench_is_one_programs_and_then_anybodys() -> None:
    with BenchLock(plan()):
        assert in_use(plan()) is not None
    assert in_use(plan()) is None


def test_benches_that_share_one_instrument_exclude_each_other() -> None:
    with BenchLock(plan("b")), pytest.raises(ConfigurationError, match="bench b is in use by pid"):
        BenchLock(plan("another", generator=5026))
    with BenchLock(plan("b")), BenchLock(plan("c", generator=5026, port="/dev/ttyY")):
        assert in_use(plan("d", generator=5026)) is not None


DRIVE = """
[stage_z]
driver = "oriental-az"
axis = "z"
port = "/dev/ttyX"
unit_id = {unit}
steps_per_mm = 1000
low_limit_mm = 0
high_limit_mm = 20
max_speed_mm_s = 20
"""


def test_a_serial_line_belongs_to_one_program_for_all_its_devices() -> None:
    """Two masters on an RS-485 line would talk into each other's answers."""
    head = 'name = "{}"\n[fixture]\nmounted = "film-clamp"\n'
    one, another = (
        parse_bench(head.format(name) + DRIVE.format(unit=unit), "bench.toml")
        for name, unit in (("one", 1), ("another", 2))
    )
    with BenchLock(one), pytest.raises(ConfigurationError, match="bench one is in use"):
        BenchLock(another)


@pytest.mark.parametrize("host", ["localhost", "127.0.0.2", "LOCALHOST", "0x7f.1"])
def test_one_instrument_under_two_host_names_is_one_bench(host: str) -> None:
    other = BENCH.replace("TCPIP0::127.0.0.1", f"tcpip::{host}")
    text = other.format(name="other", generator=5025, port="/dev/ttyY")
    with BenchLock(plan()), pytest.raises(ConfigurationError, match="bench b is in use by pid"):
        BenchLock(parse_bench(text, "bench.toml"))


def test_a_serial_port_under_two_names_is_one_bench(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, by_id = tmp_path / "ttyUSB0", tmp_path / "by-id"
    real.touch()
    by_id.mkdir()
    for link in (tmp_path / "sensor", by_id / "usb-GSV-8_123"):
        link.symlink_to(real)
    monkeypatch.setattr("rig.bench.addresses.BY_ID", by_id)
    for link in (tmp_path / "sensor", by_id / "usb-GSV-8_123"):
        with BenchLock(plan(port=str(real))), pytest.raises(ConfigurationError, match="is in use"):
            BenchLock(plan("other", generator=5026, port=str(link)))
    # Unplugged and plugged in again, it has another number and the same name by what it is.
    marks = BenchMarks(address_names(plan(port=str(real))), "b", None)
    marks.unsafe({"force_sensor": "unplugged"})
    real.unlink()
    (by_id / "usb-GSV-8_123").unlink()
    (tmp_path / "ttyUSB1").touch()
    (by_id / "usb-GSV-8_123").symlink_to(tmp_path / "ttyUSB1")
    later = address_names(plan("other", generator=5026, port=str(tmp_path / "ttyUSB1")))
    (mark,) = read_marks(later)
    assert mark.refuses
    assert set(mark.names) > set(later) & set(mark.names)


class Visa(Settings):
    resource: Address[str]


class Modbus(Settings):
    host: Address[str]
    port: Address[int]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("USB0::0x2A8D::0x4D01::MY1::INSTR", "USB::10893::19713::MY1::0::INSTR"),
        ("TCPIP::127.0.0.1::INSTR", "TCPIP0::localhost::inst0::INSTR"),
        ("TCPIP::localhost::hislip0,4880::INSTR", "TCPIP0::127.0.0.1::hislip0,4880"),
    ],
)
def test_a_resource_with_and_without_what_may_be_left_out_is_one(one: str, other: str) -> None:
    both = [addresses_of(Visa(resource=resource)) for resource in (one, other)]
    assert set(both[0]) & set(both[1])


def test_other_ports_of_one_host_and_unknown_hosts_are_several_instruments() -> None:
    one, other = (set(addresses_of(Modbus(host="127.0.0.1", port=port))) for port in (502, 503))
    assert not one & other
    assert addresses_of(Modbus(host="no.such.host.invalid", port=502)) == (
        "NO.SUCH.HOST.INVALID 502",
    )


def test_a_refused_lock_keeps_nothing() -> None:
    """The first of its instruments is free, the second is not."""
    both = plan()
    assert len(address_names(both)) == 2
    with BenchLock(plan(generator=1)), BenchLock(plan(port="/dev/ttyZ")):
        assert in_use(both) is not None
    with BenchLock(both):
        assert in_use(plan(port="/dev/ttyZ")) is not None


def test_its_owner_is_named_and_a_dead_one_has_nothing(tmp_path: Path) -> None:
    file = tmp_path / "bench.toml"
    file.write_text(BENCH.format(name="b", generator=5025, port="/dev/ttyX"))
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert holder.stdout is not None
    assert holder.stdin is not None
    assert holder.stdout.readline() == b"held\n"
    with pytest.raises(ConfigurationError) as refused:
        BenchLock(plan())
    assert refused.value.code == ExitCode.USAGE
    assert (
        f"the bench b is in use by pid {holder.pid} ({user_name(os.geteuid())}) since 20"
        in refused.value.message
    )
    assert "(run /data/run.rigj)" in refused.value.message
    holder.kill()
    holder.wait()
    holder.stdin.close()
    holder.stdout.close()
    with BenchLock(plan()):
        assert f"pid {holder.pid}" not in str(in_use(plan()))


def stop() -> None:
    raise StopRequestedError(signal.SIGINT)


def test_the_guard_of_a_dead_run_holds_its_bench_until_it_is_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program waits as long as the guard acts; a person sees why and can end the wait.

    Stands for the guard: a process that has inherited the lock of one that is gone."""
    file = tmp_path / "bench.toml"
    file.write_text(BENCH.format(name="b", generator=5025, port="/dev/ttyX"))
    heir = "import subprocess; p = subprocess.Popen(['cat'], pass_fds=lock.files); "
    text = HOLDER.replace("sys.stdin.read()", heir + "print(p.pid, flush=True)")
    run = subprocess.Popen(
        [sys.executable, "-c", text, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert run.stdin is not None
    assert run.stdout is not None
    assert run.stdout.readline() == b"held\n"
    run.stdout.readline()
    run.wait()
    assert f"pid {run.pid} (" in str(in_use(plan()))
    monkeypatch.setattr("rig.run.locks.lock.GUARD_S", 0.2)
    with pytest.raises(ConfigurationError, match="its guard is making it safe and has been waited"):
        BenchLock(plan())
    monkeypatch.setattr("rig.run.locks.lock.SAY_AFTER_S", 0.0)
    with pytest.raises(StopRequestedError):
        BenchLock(plan(), wait=GuardWait(print, stop))
    said: list[str] = []
    ends_soon = threading.Timer(0.5, run.stdin.close)  # the heir's end of input, after GUARD_S
    ends_soon.start()
    with BenchLock(plan(), wait=GuardWait(said.append)):
        assert run.stdout.read() == b""
    (reported,) = said
    assert f"waiting: the bench b was in use by pid {run.pid} (" in reported
    assert "its guard is making it safe" in reported
    assert "Ctrl-C ends the wait" in reported
    ends_soon.join()
    run.stdout.close()


def test_a_lock_that_cannot_be_opened_refuses_the_bench(tmp_path: Path) -> None:
    lock = tmp_path / "shared" / (address_names(plan())[0] + ".lock")
    lock.mkdir(parents=True)
    with pytest.raises(ConfigurationError, match="cannot be opened: Is a directory"):
        BenchLock(plan())
    lock.rmdir()
    lock.symlink_to(tmp_path / "somewhere else")
    with pytest.raises(ConfigurationError, match="cannot be opened"):
        BenchLock(plan())
    assert not (tmp_path / "somewhere else").exists()


def test_the_temporary_folder_does_not_choose_the_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with BenchLock(plan()):
        monkeypatch.setenv("TMPDIR", str(tmp_path))
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        with pytest.raises(ConfigurationError, match="in use by pid"):
            BenchLock(plan())


def test_a_removed_lock_file_does_not_give_two_runs_one_bench(tmp_path: Path) -> None:
    first = BenchLock(plan())
    marks = BenchMarks(first.names, "b", "/data/run.rigj")
    marks.running(os.getpid())
    for path in (tmp_path / "shared").glob("*.lock"):
        path.unlink()
    with pytest.raises(ConfigurationError) as refused:
        BenchLock(plan())
    assert f"in use by pid {os.getpid()} (" in refused.value.message
    assert "its lock file was removed" in refused.value.message
    assert "/data/run.rigj" in str(in_use(plan()))
    with pytest.raises(ConfigurationError, match="was removed, and another program may use"):
        first.check()  # and a run that has not begun yet does not begin
    marks.clear()
    with BenchLock(plan()) as second:
        second.check()
    first.release()


def test_a_lock_file_removed_while_it_is_waited_for_is_not_the_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It goes away between being opened and being locked, as when its owner removes it."""
    taken = []
    locked = lock.try_lock

    def removed_first(file: int) -> bool:
        if len(taken) == 0:
            for path in (tmp_path / "shared").glob("*.lock"):
                path.unlink()
        taken.append(file)
        return locked(file)

    monkeypatch.setattr(lock, "try_lock", removed_first)
    with BenchLock(plan()) as held:
        assert len(taken) == 3, "the first of two files once more"
        held.check()


def test_no_other_user_can_block_or_aim_the_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = tmp_path / "shared"
    with BenchLock(plan()) as held:
        BenchMarks(held.names, "b", None).running(os.getpid())
        assert shared.stat().st_mode & 0o777 == 0o700
        assert {path.stat().st_mode & 0o777 for path in shared.iterdir()} == {0o600}
        clear_marks(held.names)
    for path in shared.iterdir():
        path.unlink()
    shared.chmod(0o770)  # an administrator has made it for a group
    with BenchLock(plan()) as held:
        BenchMarks(held.names, "b", None).running(os.getpid())
        assert {path.stat().st_mode & 0o777 for path in shared.iterdir()} == {0o660}
        clear_marks(held.names)
    shared.chmod(0o777)
    with pytest.raises(ConfigurationError, match="can be written by everybody"):
        BenchLock(plan())
    shared.chmod(0o700)
    monkeypatch.setattr("rig.run.locks.shared_folder.os.geteuid", lambda: shared.stat().st_uid + 1)
    if shared.stat().st_uid != 0:
        with pytest.raises(ConfigurationError, match="belongs to"):
            BenchLock(plan())
    monkeypatch.undo()
    monkeypatch.setenv("RIG_SHARED_FOLDER", str(tmp_path / "link"))
    (tmp_path / "link").symlink_to(shared)
    with pytest.raises(ConfigurationError, match="cannot be opened"):
        BenchLock(plan())
