"""The program ``rig`` in processes of its own that need not import what it needs.

Half of the processor time of a short command is spent on imports. A server imports once per test
worker; each command is a process forked from it, which changes to the command's folder and calls
`rig.cli.main` as ``python -c`` does. What a command starts of the program itself, the simulated
bench first of all, is forked from the command in the same way (`ForkedPopen`): numba alone needs a
second of processor time before the first step of the contact. Tests of the start itself use a fresh
process (`conftest.Rig.start`). Packages of tests, in folders on PYTHONPATH, are found as they would
be in a fresh one.
"""

from __future__ import annotations

import atexit
import fcntl
import gc
import inspect
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any, NoReturn

LONGEST_MESSAGE = 1 << 16
MODULES = (
    *("h5py", "numpy", "pymodbus.client", "pyvisa_py.highlevel", "serial"),
    *("rig.cli.commands.procedures", "rig.cli.commands.files", "rig.cli.commands.show"),
    *("rig.cli.commands.analyse", "rig.cli.commands.resume", "rig.cli.report"),
    *("rig.files.runfile.compile", "rig.run.execute", "rig.figures.drawing"),
    *("rig.analysis.film.gain_curve", "scipy.special"),
    *("scipy.ndimage", "procedures.sweep", "procedures.slip_trial.trial"),
    *("procedures.roll_trial.trial", "drivers.festo_cmmt.driver"),
    *("drivers.keysight_33500b.driver", "drivers.keysight_u2300a.driver"),
    *("drivers.me_gsv8.driver", "drivers.oriental_az.driver", "drivers.zaber_rst.driver"),
    *("drivers.simulated.bench.start", "drivers.simulated.faults.disk"),
    *("drivers.simulated.bench.process", "drivers.simulated.world.plate_world"),
    "rig.run.making_safe.guard",
)
FORKED_MODULES = ("drivers.simulated.bench.process", "rig.run.making_safe.guard")
"""Not the worker of a batch: SQLite does not survive a fork."""
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
        """Return whether Python would find other modules in this environment under the names that
        have been imported. Folders on PYTHONPATH may hold modules of other names."""
        changed = {
            name
            for name in {*env, *self._environment}
            if name.startswith("PYTHON") and env.get(name) != self._environment.get(name)
        }
        if not changed:
            return False
        if changed != {"PYTHONPATH"} or "PYTHONPATH" in self._environment:
            return True
        return any(map(_holds_known_names, _folders(env)))

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

    def processor_time_s(self) -> float:
        """Return the processor time in s of all commands that have ended, with what they waited for
        themselves."""
        numbers = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(numbers[13]) + int(numbers[14])) / os.sysconf("SC_CLK_TCK")

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


def _folders(env: Mapping[str, str]) -> list[str]:
    """Return the folders on PYTHONPATH."""
    return [folder for folder in env.get("PYTHONPATH", "").split(os.pathsep) if folder]


def _holds_known_names(folder: str) -> bool:
    """Return whether a folder has a module of which there is, or may be, another one."""
    return not _known_names().isdisjoint(path.stem for path in Path(folder).glob("*"))


@cache
def _known_names() -> set[str]:
    """Return the names of the modules that are installed, and of those that `site` looks for."""
    ours = {"rig", "procedures", "drivers", "forked_rig", "compiled_kernels"}
    looked_for = {"sitecustomize", "usercustomize"}
    return {*ours, *looked_for, *sys.stdlib_module_names, *packages_distributions()}


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
    assert _threads() == 1, "a fork would lose threads"
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
    _make_simulators()


def _make_simulators() -> None:
    """Make the simulated instruments once, as far as they need no thread and no port: the 160
    expressions of their command tables stay compiled."""

    from drivers.simulated.bench.mounted import Instruments
    from drivers.simulated.bench.options import Options
    from drivers.simulated.faults.plan import FaultPlan
    from drivers.simulated.world.settings import WorldSettings
    from drivers.simulated.world.world import World

    Instruments(World(WorldSettings(), 0, True, None, ()), Options(), FaultPlan())


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
    # As in a terminal, also where a shell runs the tests in the background, with Ctrl-C ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.setpgid(0, 0)
    for number, descriptor in enumerate(descriptors, 1):
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.environ.clear()
    os.environ.update(job["env"])
    time.tzset()
    os.chdir(job["folder"])
    sys.argv = ["-c", *job["arguments"]]
    subprocess.Popen = ForkedPopen  # type: ignore[misc]
    sys.path[1:1] = _folders(job["env"])
    from rig.cli import main
    from rig.core import entry_points

    entry_points._registered.cache_clear()

    _end_after(main)


# --- in the process of a command -----------------------------------------------------------------


class ForkedPopen(subprocess.Popen[Any]):
    """A `subprocess.Popen` that forks this process where it is asked for one of `FORKED_MODULES`.

    What has been imported here need not be imported there. Where this process has a second thread,
    which a fork would lose, and for every other program, it is the usual one.
    """

    def _execute_child(self, args: Any, *others: Any) -> None:
        """Start the process; `others` are those of `subprocess.Popen._execute_child`."""
        module = _forked_module(args)
        if module is None or _threads() > 1:
            super()._execute_child(args, *others)  # type: ignore[misc]
            return
        named = dict(zip(EXECUTE_CHILD, others, strict=True))
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        # A signal that comes early must not meet the handlers of this process in the other one.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        try:
            self.pid = os.fork()
            if self.pid == 0:
                _become_module(module, list(args), named, mask)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        self._child_created = True
        ends = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")
        self._close_pipe_fds(*(named[end] for end in ends))  # type: ignore[attr-defined]


EXECUTE_CHILD = list(inspect.signature(subprocess.Popen._execute_child).parameters)[2:]
"""Names of the arguments of `subprocess.Popen._execute_child` after the program."""


def _threads() -> int:
    return len(list(Path("/proc/self/task").iterdir()))


def _forked_module(args: Any) -> str | None:
    """Return the module of ``python -P -m module ...``, if it is one of `FORKED_MODULES`."""
    program = list(args) if isinstance(args, list | tuple) else []
    if program[:3] == [sys.executable, "-P", "-m"] and program[3] in FORKED_MODULES:
        return str(program[3])
    return None


def _become_module(
    module: str, program: list[str], named: Mapping[str, Any], mask: set[int]
) -> None:
    """Run a module in this process as ``python -P -m`` does, and end it. Of the files of the
    process before, those stay open that would stay open there. Signals are blocked; `mask` are
    those that stay blocked."""
    try:
        signal.set_wakeup_fd(-1)
        for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
            if callable(signal.getsignal(number)):
                signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if named["start_new_session"]:
            os.setsid()
        if named["process_group"] not in (None, -1):
            os.setpgid(0, named["process_group"])
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        _take_streams(named)
        if named["env"] is not None:
            os.environ.clear()
            os.environ.update({os.fsdecode(k): os.fsdecode(v) for k, v in named["env"].items()})
        if named["cwd"] is not None:
            os.chdir(named["cwd"])
        sys.path[:] = [folder for folder in sys.path if folder]  # -P
        sys.argv = [module, *program[4:]]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # that it has been imported is the aim
            atexit._clear()  # what this process has registered is none of the new one's
            _end_after(lambda: runpy.run_module(module, run_name="__main__", alter_sys=True))
    except BaseException:  # noqa: BLE001 - as the interpreter does
        traceback.print_exc()
    finally:
        os._exit(1)


def _end_after(program: Callable[[], object]) -> NoReturn:
    """Run the program and end this process as the interpreter does: after the threads that are no
    daemons, and what was registered for the exit.

    Only the modules are not taken down. A fork shares their memory until it is written to, so that
    this alone takes 0.1 s of processor time.
    """
    code = 1
    try:
        program()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:  # noqa: BLE001 - as the interpreter does
        traceback.print_exc()
    finally:
        threading._shutdown()
        atexit._run_exitfuncs()
        try:
            sys.stdout.flush()
        except (OSError, ValueError):
            code = 120
        with suppress(OSError, ValueError):
            sys.stderr.flush()
        os._exit(code)


def _take_streams(named: Mapping[str, Any]) -> None:
    """Take the three standard streams that were asked for; close what is not passed on."""
    wanted = [named["p2cread"], named["c2pwrite"], named["errwrite"]]
    passed = sorted(named["pass_fds"])
    # Out of the way first: one of them may have the number of another's place.
    free = 1 + max([2, *passed])
    taken = [fd if fd == -1 else fcntl.fcntl(fd, fcntl.F_DUPFD, free) for fd in wanted]
    for number, descriptor in enumerate(taken):
        if descriptor != -1:
            os.dup2(descriptor, number)
    low = 3
    for descriptor in [*passed, os.sysconf("SC_OPEN_MAX")]:
        os.closerange(low, descriptor)
        low = descriptor + 1
    for descriptor in passed:
        os.set_inheritable(descriptor, True)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 - open until the end
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
