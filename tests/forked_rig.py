"""The program ``rig`` in processes of its own that need not import what it needs.

Half of the processor time of a short command is spent on imports. A server imports once per test
worker; each command is a process forked from it, which changes to the command's folder and calls
`rig.cli.main` as ``python -c`` does. The simulated bench that a command starts is forked from the
command in the same way (`forked_bench`): numba alone needs a second of processor time before the
first step of the contact. Tests of the start itself use a fresh process (`conftest.Rig.start`).
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

LONGEST_MESSAGE = 1 << 16
MODULES = (
    *("h5py", "numpy", "pymodbus.client", "pyvisa_py.highlevel", "serial"),
    *("rig.cli.procedures", "rig.cli.report", "rig.files.runfile.compile", "rig.run.execute"),
    *("rig.cli.files", "rig.figures.drawing", "rig.analysis.film.gain_curve", "scipy.special"),
    *("scipy.ndimage", "procedures.sweep", "procedures.slip_trial.trial"),
    *("procedures.roll_trial.trial", "drivers.festo_cmmt.driver"),
    *("drivers.keysight_33500b.driver", "drivers.keysight_u2300a.driver"),
    *("drivers.me_gsv8.driver", "drivers.oriental_az.driver", "drivers.zaber_rst.driver"),
    *("drivers.simulated.bench.start", "drivers.simulated.faults.disk"),
    *("drivers.simulated.bench.process", "drivers.simulated.world.plate_world"),
)
SERVER = (
    f"import sys; sys.path.append({str(Path(__file__).parent)!r})\n"
    "import forked_rig, compiled_kernels; sys.path.pop(); forked_rig.serve(int(sys.argv[1]))"
)


def environment() -> dict[str, str]:
    """Return the environment of a command: this process's, without what changes its output."""
    return {k: v for k, v in os.environ.items() if k not in ("FORCE_COLOR", "TERM")}


class ForkedProcess:
    """A command that the server has started, with the members of `subprocess.Popen` that tests
    use."""

    def __init__(self, server: Server, pid: int, stdout: int, stderr: int):
        self._server = server
        self.pid = pid
        self.returncode: int | None = None
        self.stdout = os.fdopen(stdout)
        self.stderr = os.fdopen(stderr)

    def poll(self) -> int | None:
        """Return its exit code, or None while it runs."""
        if self.returncode is None:
            self.returncode = self._server.exit_code(self.pid)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; return its exit code. Raises TimeoutExpired after `timeout` seconds."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if deadline is not None and time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("rig", timeout or 0.0)
            self._server.await_news(0.1)
        return code

    def send_signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def terminate(self) -> None:
        """Ask it to end."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Kill it."""
        self.send_signal(signal.SIGKILL)


class Server:
    """The process that forks commands."""

    def __init__(self) -> None:
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._environment = environment()
        self._codes: dict[int, int] = {}
        self._lock = threading.Lock()
        """Held while messages are received: each may belong to another thread's command."""
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", SERVER, str(theirs.fileno())],
                env=self._environment,
                stdin=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                process_group=0,
            )
        atexit.register(self.close)

    def imported_otherwise(self, env: Mapping[str, str]) -> bool:
        """Return whether Python would find other modules in this environment."""
        return any(
            env.get(name) != self._environment.get(name)
            for name in {*env, *self._environment}
            if name.startswith("PYTHON")
        )

    def start(
        self, arguments: Sequence[str], folder: Path, env: Mapping[str, str] | None = None
    ) -> ForkedProcess:
        """Start ``rig`` with `arguments` in `folder`, in a process group of its own.

        Its environment is `env`, or that in which the server was started.
        """
        (stdout, its_stdout), (stderr, its_stderr) = os.pipe(), os.pipe()
        asked = {"folder": str(folder), "arguments": list(arguments)}
        job = json.dumps({**asked, "env": dict(env or self._environment)}).encode()
        with self._lock:
            socket.send_fds(self._control, [job], [its_stdout, its_stderr])
            while "begun" not in (news := self._receive()):
                pass
        os.close(its_stdout)
        os.close(its_stderr)
        return ForkedProcess(self, news["begun"], stdout, stderr)

    def exit_code(self, pid: int) -> int | None:
        """Return the exit code of a command, once; None while it runs."""
        with self._lock:
            while select.select([self._control], [], [], 0)[0]:
                self._receive()
            return self._codes.pop(pid, None)

    def await_news(self, at_most_s: float) -> None:
        """Wait until a command has ended, no longer than this."""
        select.select([self._control], [], [], at_most_s)

    def close(self) -> None:
        """End the server. Commands that run are left alone."""
        self._control.close()
        self._process.wait()

    def _receive(self) -> Mapping[str, Any]:
        message = self._control.recv(LONGEST_MESSAGE)
        assert message, "the server that forks commands has died"
        news: dict[str, Any] = json.loads(message)
        if "ended" in news:
            self._codes[news["ended"]] = news["code"]
        return news


@cache
def server() -> Server:
    """Return the server of this test worker."""
    return Server()


# --- in the server's process ---------------------------------------------------------------------


def serve(control_descriptor: int) -> None:
    """Fork commands until the other end of the socket is closed."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `rig.cli.main` sets it
    _import_without_a_thread()
    gc.freeze()
    assert len(list(Path("/proc/self/task").iterdir())) == 1, "a fork would lose threads"
    control = socket.socket(fileno=control_descriptor)
    woken, waker = socket.socketpair()
    for end in (woken, waker):
        end.setblocking(False)
    signal.set_wakeup_fd(waker.fileno(), warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    while True:
        ready, _, _ = select.select([control, woken], [], [])
        if woken in ready:
            woken.recv(LONGEST_MESSAGE)
            _report_ended(control)
        if control in ready:
            message, descriptors, _, _ = socket.recv_fds(control, LONGEST_MESSAGE, 2)
            if not message:
                return
            child = os.fork()
            if child == 0:
                for end in (control, woken, waker):
                    end.close()
                break
            with suppress(OSError):  # the child does so, too: whoever comes first
                os.setpgid(child, child)
            for descriptor in descriptors:
                os.close(descriptor)
            control.send(json.dumps({"begun": child}).encode())
    _become_rig(json.loads(message), descriptors)


def _import_without_a_thread() -> None:
    """Import what commands need.

    pyvisa-py searches for USB devices while it is imported. Where libusb is installed that starts a
    thread, which a forked process would not have, so the search finds nothing here.
    """
    import usb.core

    search = usb.core.find
    usb.core.find = lambda *arguments, **keywords: None
    try:
        for name in MODULES:
            import_module(name)
    finally:
        usb.core.find = search
    from compiled_kernels import call_kernels

    call_kernels()


def _report_ended(control: socket.socket) -> None:
    with suppress(ChildProcessError):
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            code = os.waitstatus_to_exitcode(status)
            control.send(json.dumps({"ended": pid, "code": code}).encode())


def _become_rig(job: Mapping[str, Any], descriptors: Sequence[int]) -> None:
    """Call the program's entry point in this process, which it ends."""
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.setpgid(0, 0)
    for number, descriptor in enumerate(descriptors, 1):
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.environ.clear()
    os.environ.update(job["env"])
    time.tzset()
    os.chdir(job["folder"])
    sys.argv = ["-c", *job["arguments"]]
    from drivers.simulated.bench import start

    start.begin_process = partial(forked_bench, start.begin_process)
    from rig.cli import main

    main()


# --- in the process of a command -----------------------------------------------------------------


class ForkedBench:
    """The process of a simulated bench, with the members of `subprocess.Popen` that its owner
    uses."""

    def __init__(self, pid: int, stdin: int, stdout: int, stderr: int):
        self.pid = pid
        self.returncode: int | None = None
        self.stdin = os.fdopen(stdin, "wb")
        self.stdout = os.fdopen(stdout, "rb")
        self.stderr = os.fdopen(stderr, "rb")

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; return its exit code. Raises TimeoutExpired after `timeout` seconds."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
            elif deadline is not None and time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("bench", timeout or 0.0)
            else:
                time.sleep(0.002)
        return self.returncode

    def terminate(self) -> None:
        """Ask it to end."""
        if self.returncode is None:
            os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """Kill it."""
        if self.returncode is None:
            os.kill(self.pid, signal.SIGKILL)


def forked_bench(begin_process: Callable[[], Any]) -> Any:
    """Begin the process of a bench by a fork of this one, in place of `begin_process`, which is
    used where a fork would lose threads."""
    if len(list(Path("/proc/self/task").iterdir())) > 1:
        return begin_process()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    ours_in, ours_out, ours_err = os.pipe(), os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        _become_bench(ours_in[0], ours_out[1], ours_err[1])
    for descriptor in (ours_in[0], ours_out[1], ours_err[1]):
        os.close(descriptor)
    return ForkedBench(child, ours_in[1], ours_out[0], ours_err[0])


def _become_bench(*streams: int) -> None:
    """Run the bench in this process, which it ends; nothing of the command's remains open here."""
    code = 1
    try:
        os.setsid()
        signal.set_wakeup_fd(-1)
        for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
            if callable(signal.getsignal(number)):
                signal.signal(number, signal.SIG_DFL)
        for number, descriptor in enumerate(streams):
            os.dup2(descriptor, number)
        os.closerange(3, os.sysconf("SC_OPEN_MAX"))
        sys.stdin, sys.stdout, sys.stderr = open(0), open(1, "w"), open(2, "w")  # noqa: SIM115
        from drivers.simulated.bench import process

        process.main()
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):
                stream.flush()
        os._exit(code)
