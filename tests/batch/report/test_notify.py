"""Notifications by real processes and over HTTP on this computer; nothing of them disturbs."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
from collections.abc import Iterator
from datetime import datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from rig.batch.plan.settings import NotifySettings
from rig.batch.report import notify as notification
from rig.batch.report.notify import MOST_MEMORY, Notifier, require_usable
from rig.core.errors import ConfigurationError

KEEPS = (
    "import json, sys;"
    "open(sys.argv[1], 'a').write(json.dumps([sys.argv[2:], json.load(sys.stdin)]) + chr(10))"
)
CLOSING_S = 60.0


def command(program: str, *arguments: str) -> NotifySettings:
    return NotifySettings(command=(sys.executable, "-c", program, *arguments))


def test_a_command_gets_title_and_text_as_arguments_and_all_of_it_as_json(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    notifier = Notifier(command(KEEPS, str(kept)))
    notifier.notify("hold", "night-1: on hold", "film 'F12' is worn", {"run": 12, "file": kept})
    assert notifier.close(CLOSING_S) == []
    arguments, said = json.loads(kept.read_text())
    assert arguments == ["night-1: on hold", "film 'F12' is worn"]
    assert said["occasion"] == "hold"
    assert [said["title"], said["text"]] == arguments
    assert said["details"] == {"run": 12, "file": str(kept)}
    assert datetime.fromisoformat(said["time"]).tzinfo is not None


def test_several_are_reported_in_their_order_and_only_of_what_was_asked_for(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    settings = command(KEEPS, str(kept)).model_copy(update={"on": ("failure", "end")})
    notifier = Notifier(settings)
    for number in range(4):
        notifier.notify("failure", f"run {number} failed", "")
        notifier.notify("start", "not asked for", "")
    notifier.notify("end", "over", "")
    assert notifier.close(CLOSING_S) == []
    titles = [json.loads(line)[0][0] for line in kept.read_text().splitlines()]
    assert titles == [f"run {number} failed" for number in range(4)] + ["over"]


def test_a_command_that_fails_is_a_warning_and_in_the_log(caplog) -> None:
    notifier = Notifier(command("import sys; sys.exit('no network')"))
    notifier.notify("failure", "run 3 failed", "")
    (warning,) = notifier.close(CLOSING_S)
    assert warning == "notify.command: 'run 3 failed' was not sent: exit code 1: no network"
    assert warning in caplog.text
    assert notifier.poll() == [], "each is reported once"


@pytest.mark.thorough
def test_a_command_that_hangs_is_killed_with_what_it_has_started(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    program = (
        "import subprocess, sys, time, os;"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)']);"
        "open(sys.argv[1] + '.new', 'w').write(str(child.pid));"
        "os.replace(sys.argv[1] + '.new', sys.argv[1]); time.sleep(600)"
    )
    notifier = Notifier(command(program, str(pid_file)), longest_s=3.0)
    notifier.notify("end", "over", "")
    (warning,) = notifier.close(CLOSING_S)
    assert "it did not finish within 3 s" in warning
    pid = int(pid_file.read_text())
    deadline = time.monotonic() + CLOSING_S
    while running(pid):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def running(pid: int) -> bool:
    """Return whether a process runs; one that has ended and that nobody has waited for does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_what_a_command_leaves_running_neither_delays_later_messages_nor_stays(
    tmp_path: Path,
) -> None:
    """What it leaves holds the command's outputs open."""
    pids = tmp_path / "pids"
    program = (
        "import subprocess, sys;"
        "left = subprocess.Popen(['sleep', '600']);"
        "open(sys.argv[1], 'a').write(f'{left.pid}' + chr(10))"
    )
    notifier = Notifier(command(program, str(pids)))
    for number in range(2):
        notifier.notify("end", f"message {number}", "")
    assert notifier.close(CLOSING_S) == []
    left = [int(line) for line in pids.read_text().splitlines()]
    assert len(left) == 2
    deadline = time.monotonic() + 10
    while any(_alive(pid) for pid in left) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(_alive(pid) for pid in left)


def _alive(pid: int) -> bool:
    """Whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.thorough
def test_telling_does_not_wait_and_what_is_not_delivered_in_time_is_given_up() -> None:
    notifier = Notifier(command("import time; time.sleep(20)"), longest_s=20.0)
    for number in range(notification.MOST_WAITING + 5):
        notifier.notify("failure", f"run {number}", "")
    warnings = notifier.poll()
    assert len(warnings) == 4, "one is under way, 100 wait"
    assert all("100 messages are waiting already" in warning for warning in warnings)
    given_up = notifier.close(0.1)
    assert len(given_up) == 101
    assert all("given up after 0.1 s" in warning for warning in given_up)


@pytest.mark.thorough
def test_a_command_that_prints_tens_of_megabytes_ends_by_itself(tmp_path: Path) -> None:
    """What it prints beyond the end that may be shown is read and dropped."""
    program = (
        "import sys\n"
        "for _ in range(64): sys.stdout.write('x' * (1 << 20)); sys.stderr.write('y' * (1 << 20))\n"
        "open(sys.argv[1], 'w').write('delivered')\n"
        "sys.exit('no network')\n"
    )
    notifier = Notifier(command(program, str(tmp_path / "kept")), longest_s=50.0)
    notifier.notify("end", "over", "")
    (warning,) = notifier.close(CLOSING_S)
    assert (tmp_path / "kept").read_text() == "delivered", warning
    assert "exit code 1: yyyy" in warning


@pytest.mark.thorough
def test_one_that_hangs_and_one_that_floods_do_not_stop_later_messages(tmp_path: Path) -> None:
    """Each costs its own time limit; what it writes is read up to a bound."""
    arrived = tmp_path / "arrived"
    program = (
        "import sys, time\n"
        "if sys.argv[2] == 'hangs': time.sleep(600)\n"
        "while sys.argv[2] == 'floods': sys.stderr.write('x' * 65536)\n"
        "open(sys.argv[1], 'a').write(sys.argv[2] + chr(10))\n"
    )
    notifier = Notifier(command(program, str(arrived)), longest_s=2.0)
    for title in ("hangs", "floods", "arrives"):
        notifier.notify("failure", title, "")
    hung, flooded = notifier.close(CLOSING_S)
    assert hung == "notify.command: 'hangs' was not sent: it did not finish within 2 s"
    assert flooded.startswith(
        "notify.command: 'floods' was not sent: it did not finish within 2 s: x"
    )
    assert len(flooded) < 400
    assert arrived.read_text() == "arrives\n"


def test_what_no_program_can_be_given_disturbs_nobody(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    notifier = Notifier(command(KEEPS, str(kept)))
    notifier.notify("failure", "a\0b", "x" * 100_000, {"set": {1, 2}})
    assert notifier.close(CLOSING_S) == []
    (title, text), _ = json.loads(kept.read_text())
    assert title == "a b"
    assert len(text) == notification.LONGEST


def test_a_command_that_is_gone_by_then_is_a_warning() -> None:
    notifier = Notifier(NotifySettings(command=("/nowhere/notify-send",)))
    notifier.notify("start", "begun", "")
    (warning,) = notifier.close(CLOSING_S)
    assert "No such file" in warning


@pytest.fixture
def listener() -> Iterator[ThreadingHTTPServer]:
    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            server.said.append(json.loads(body))  # type: ignore[attr-defined]
            self.send_response(500 if self.path == "/refuses" else 200)
            self.end_headers()
            if self.path == "/endless":
                with contextlib.suppress(OSError):  # who has asked has given up
                    for _ in range(2 * MOST_MEMORY >> 20):
                        self.wfile.write(bytes(1 << 20))

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.said = []  # type: ignore[attr-defined]
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.thorough
def test_an_address_of_apprise_is_reported_and_one_that_refuses_is_a_warning(listener) -> None:
    here = f"json://user:secret@127.0.0.1:{listener.server_address[1]}"
    notifier = Notifier(
        NotifySettings(urls=(f"{here}/refuses", f"{here}/takes")), longest_s=CLOSING_S
    )
    notifier.notify("hold", "night-1: on hold", "the disk is full")
    (warning,) = notifier.close(CLOSING_S)
    assert [(said["title"], said["message"], said["type"]) for said in listener.said] == 2 * [
        ("night-1: on hold", "the disk is full", "warning")
    ]
    assert "notify.urls: address 1: 'night-1: on hold' was not sent: exit code 1: " in warning
    assert "secret" not in warning


@pytest.mark.thorough
def test_an_address_that_answers_without_end_does_not_take_the_memory_of_a_run(listener) -> None:
    url = f"json://127.0.0.1:{listener.server_address[1]}/endless"
    notifier = Notifier(NotifySettings(urls=(url,)), longest_s=CLOSING_S)
    notifier.notify("end", "night-1: end", "all is well")
    (warning,) = notifier.close(CLOSING_S)
    # A slow computer gives it up before it has read so much.
    assert "notify.urls: address 1: 'night-1: end' was not sent: " in warning


def test_what_could_never_be_delivered_is_refused_beforehand(monkeypatch) -> None:
    require_usable(NotifySettings())
    require_usable(NotifySettings(command=(sys.executable,), urls=("json://127.0.0.1:9",)))
    with pytest.raises(ConfigurationError, match="no-such-program"):
        require_usable(NotifySettings(command=("no-such-program", "-x")))
    with pytest.raises(ConfigurationError, match=r"address 2 \(nosuch://\.\.\.\)") as refused:
        require_usable(NotifySettings(urls=("json://127.0.0.1:9", "nosuch://user:secret@host")))
    assert "secret" not in refused.value.one_line()
    monkeypatch.setitem(sys.modules, "apprise", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigurationError) as refused:
        require_usable(NotifySettings(urls=("json://127.0.0.1:9",)))
    assert 'uv pip install "tactile-rig[notify]"' in refused.value.one_line()
