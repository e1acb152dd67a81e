"""The server, asked as a browser, a stranger's page and a hostile program would ask it."""

from __future__ import annotations

import http.client
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import recorded_run as run

from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run

PATIENCE_S = 60.0
WRITER = """
import sys, time, signal
sys.path.insert(0, sys.argv[2])
import recorded_run as run
from rig.files.journal.writer import JournalWriter
asked = []
signal.signal(signal.SIGTERM, lambda *_: asked.append(1))
with JournalWriter.create(sys.argv[1], run.header()) as journal:
    run.take_point(journal, 0)
    journal.point_begin(run.POINTS[1], {"time": 1.0})
    journal.sync()
    print("recording", flush=True)
    n = 0
    while not asked:
        journal.block(0, 500 + 10 * n, 2.0 + 0.05 * n, run.samples(1, 10))
        n += 1
        time.sleep(0.05)
    journal.point_discard(run.POINTS[1], "stopped by SIGTERM")
    journal.end(run.end("stopped", points=1, exit=143))
    journal.sync()
    sys.stdin.read()
"""


@dataclass
class Page:
    """A served page."""

    port: int
    stop_token: str
    watch_token: str
    results: Path

    def ask(self, method: str, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
        body = headers.pop("body", None)
        headers = {name.replace("_", "-"): text for name, text in headers.items()}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            connection.request(method, path, body=body, headers=headers)
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            connection.close()

    def bearer(self, token: str = "") -> dict[str, str]:
        return {"Authorization": f"Bearer {token or self.stop_token}"}

    def frames(self, until: Any) -> dict[str, Any]:
        """Frames of the stream until one suits; that one."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        give_up = time.monotonic() + PATIENCE_S
        try:
            connection.request("GET", "/api/live", headers=self.bearer())
            answer = connection.getresponse()
            while time.monotonic() < give_up:
                line = answer.readline()
                if line.startswith(b"data: "):
                    frame = json.loads(line[6:])
                    if until(frame):
                        return frame
            raise AssertionError(f"no such frame, the latest: {frame}")
        finally:
            connection.close()


def start(results: Path, *options: str) -> subprocess.Popen[str]:
    main = "from rig.cli import main; main()"
    command = [sys.executable, "-c", main, "page", "--port", "0", "--results", str(results)]
    return subprocess.Popen(
        [*command, *options], stderr=subprocess.PIPE, text=True, cwd=results.parent
    )


def serve(results: Path, *options: str) -> tuple[subprocess.Popen[str], Page]:
    process = start(results, *options)
    assert process.stderr is not None
    tokens, port = {}, 0
    for line in process.stderr:
        if found := re.match(r"watch (and stop|only): +http://127.0.0.1:(\d+)/#token=(\S+)", line):
            tokens[found[1]], port = found[3], int(found[2])
        if line.startswith("showing"):
            break
    return process, Page(port, tokens.get("and stop", ""), tokens["only"], results)


def test_a_folder_that_did_not_exist_is_named(tmp_path):
    wrong = tmp_path / "reslts"
    with start(wrong) as process:
        assert process.stderr is not None
        lines = list(itertools.takewhile(lambda line: "showing" not in line, process.stderr))
        process.send_signal(signal.SIGINT)
    assert f"{wrong} did not exist: name the folder of the runs with --results" in lines[-1]


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "results").write_text("a file")
    with start(tmp_path / "results") as process:
        assert process.stderr is not None
        (line,) = process.stderr
    assert process.wait() == 2
    assert str(tmp_path / "results") in line


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Iterator[Page]:
    results = tmp_path_factory.mktemp("page") / "results"
    day = results / "2026-11-21"
    day.mkdir(parents=True)
    (results.parent / "secret.txt").write_text("secret")
    compile_run(run.write_run(day / "2026-11-21T22-00-00_sweep_r001.rigj"), retire=True)
    process, served = serve(results)
    yield served
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE_S) == 130


def test_only_the_page_itself_is_given_without_a_token_and_every_answer_forbids_framing(page):
    for path in ("/", "/static/page.js", "/static/uplot.js"):
        status, headers, _ = page.ask("GET", path)
        assert status == 200
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert headers["x-frame-options"] == "DENY"
    for path in ("/api/live", "/api/night", "/api/runs", "/api/runs/x", "/api/stop"):
        for given in ({}, page.bearer("wrong"), {"Authorization": page.stop_token}):
            method = "POST" if path == "/api/stop" else "GET"
            status, headers, body = page.ask(method, path, **given)
            assert (status, headers["x-frame-options"]) == (401, "DENY")
            assert b"sweep" not in body
    assert page.ask("GET", f"/api/runs?token={page.stop_token}")[0] == 401


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "127.0.0.1.evil.example:80"},
        {"Host": "localhost", "Origin": "http://evil.example"},
        {"Host": "localhost", "Origin": "null"},
        {"Host": "localhost", "Sec-Fetch-Site": "cross-site"},
        {"Host": "localhost", "Sec-Fetch-Site": "same-site"},
    ],
)
def test_a_foreign_host_and_a_foreign_origin_are_refused_even_with_the_token(page, headers):
    for method, path in (("GET", "/api/runs"), ("POST", "/api/stop"), ("POST", "/api/make-safe")):
        assert page.ask(method, path, **page.bearer(), **headers)[0] == 403


def test_a_tunnel_from_another_desk_has_another_port_and_the_same_origin(page):
    there = {"Host": "localhost:9000", "Origin": "http://localhost:9000"}
    assert page.ask("GET", "/api/runs", **page.bearer(), **there)[0] == 200


def test_nothing_is_changed_by_a_get_nor_by_who_may_only_watch(page):
    for path in ("/api/stop", "/api/make-safe"):
        assert page.ask("GET", path, **page.bearer())[0] == 405
        assert page.ask("POST", path, **page.bearer(page.watch_token))[0] == 403
    assert page.ask("POST", "/api/stop", **page.bearer(), body="x" * 5000)[0] == 413
    for body in ("[1]", "[" * 1024, "\xff", "no JSON", '{"what": ["run"]}'):
        assert page.ask("POST", "/api/stop", **page.bearer(), body=body)[0] == 400
    assert page.ask("POST", "/api/stop", **page.bearer(), body='{"what": "all"}')[0] == 400
    status, _, body = page.ask("POST", "/api/stop", **page.bearer(), body="{}")
    assert (status, b"no run holds the bench" in body) == (409, True)
    status, _, body = page.ask("POST", "/api/make-safe", **page.bearer())
    assert (status, b"--bench" in body) == (409, True)


def test_a_runs_files_are_handed_out_and_no_other_path_is_reachable(page):
    status, _, body = page.ask("GET", "/api/runs", **page.bearer())
    give_up = time.monotonic() + PATIENCE_S
    while not (listed := json.loads(body)["runs"]) and time.monotonic() < give_up:
        time.sleep(0.1)
        status, _, body = page.ask("GET", "/api/runs", **page.bearer())
    (found,) = listed
    assert (found["procedure"], found["status"], found["mark"]) == (
        "sweep",
        "complete",
        "SIMULATED",
    )
    assert not os.path.isabs(found["name"])  # noqa: PTH117 - a text of an answer
    run_id = found["id"]
    status, _, body = page.ask("GET", f"/api/runs/{run_id}", **page.bearer())
    shown = json.loads(body)
    assert shown["summary"]["points_done"] == 5
    assert str(page.results) not in body.decode()
    name = found["name"]
    status, _, body = page.ask("GET", f"/api/runs/{run_id}/{name}", **page.bearer())
    assert (status, body) == (200, next(page.results.glob("*/*.h5")).read_bytes())
    for hostile in (
        "../../secret.txt", "..%2f..%2fsecret.txt", "%2e%2e/%2e%2e/secret.txt", "/etc/passwd",
        "%2fetc%2fpasswd", "..\\..\\secret.txt", f"{name}%00.png", f"../{name}", ".",
    ):  # fmt: skip
        for path in (f"/api/runs/{run_id}/{hostile}", f"/api/runs/{hostile}/{name}",
                     f"/static/{hostile}", f"/{hostile}"):  # fmt: skip
            status, _, body = page.ask("GET", path, **page.bearer())
            assert (status, b"secret" in body, b"root:" in body) == (404, False, False), path


def test_a_live_run_is_shown_and_stopped_and_the_page_is_red_until_its_end_record(page):
    path = page.results / "2026-11-22" / "2026-11-22T10-00-00_sweep_r001.rigj"
    path.parent.mkdir(exist_ok=True)
    files = str(Path(run.__file__).parent)
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path), files],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert writer.stdout is not None
        writer.stdout.readline()
        # On a busy computer the page may have read a point while more is still to be read, and
        # then its word is unknown.
        frame = page.frames(
            lambda f: f["word"] == "running" and f["run"].get("point") and f["series"]
        )
        assert frame["holder"]["pid"] == writer.pid
        assert (frame["run"]["n"], frame["run"]["mark"]) == (2, "SIMULATED")
        idle = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(2)]
        for viewer in idle:  # who ask and never read delay nobody
            request = f"GET /api/live HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {page.watch_token}\r\n\r\n"  # noqa: E501
            viewer.sendall(request.encode())
        status, _, body = page.ask("POST", "/api/stop", **page.bearer(), body='{"what": "run"}')
        assert (status, str(writer.pid) in body.decode()) == (200, True)
        ended = page.frames(lambda f: f["stop"] and f["stop"]["over"])
        assert (ended["stop"]["phase"], ended["stop"]["safe"]) == ("ended", True)
        assert (ended["word"], ended["run"]["end"]["exit"]) == ("holding", 143)
        assert writer.stdin is not None
        writer.stdin.close()
        assert writer.wait(PATIENCE_S) == 0
        page.frames(lambda f: f["word"] == "safe")
        for viewer in idle:
            viewer.close()
    finally:
        writer.kill()
        writer.wait()


@pytest.mark.thorough
def test_a_run_that_was_killed_is_unsafe_until_its_guard_has_reported(page):
    path = page.results / "2026-11-22" / "2026-11-22T11-00-00_sweep_r002.rigj"
    path.parent.mkdir(exist_ok=True)
    writer = run.start_writer(path)
    try:
        page.frames(lambda f: f["holder"] and f["holder"]["pid"] == writer.pid)
        page.frames(lambda f: f["run"].get("procedure") == "sweep")
        begun = path.stat().st_size
        while path.stat().st_size < 3 * begun:  # so that half of it has the whole header
            writer.stdout.readline()
        writer.kill()
        writer.wait()
        dead = page.frames(lambda f: f["word"] == "UNSAFE")
        assert "guard has not reported" in dead["reason"]
        report = {"journal": str(path.resolve()), "run_pid": writer.pid, "safe": True,
                  "stopped": True, "cause": "died", "file": "a.h5",
                  "pressed": "nothing is pressed at 1.00 mm, 0.0 N", "released": True}  # fmt: skip
        path.with_suffix(".guard.json").write_text(json.dumps(report))
        assert "guard reported" in page.frames(lambda f: f["word"] == "safe")["reason"]
        os.truncate(path, path.stat().st_size // 2)
        page.frames(lambda f: any("was cut to" in e["text"] for e in f["events"]))
        page.frames(lambda f: f["run"].get("procedure") == "sweep")
    finally:
        writer.kill()
        writer.wait()


def test_bytes_in_a_journal_that_are_not_a_record_are_said_once(page):
    path = page.results / "2026-11-22" / "2026-11-22T12-00-00_sweep_r003.rigj"
    path.parent.mkdir(exist_ok=True)
    with JournalWriter.create(path, run.header()) as writer:
        run.take_point(writer, 0)
        page.frames(lambda f: f["run"].get("done") == 1)
        with path.open("ab") as journal:
            journal.write(bytes(50))
        page.frames(lambda f: any("cannot be shown: bad record" in e["text"] for e in f["events"]))
        run.take_point(writer, 1)
        time.sleep(1.0)
        frame = page.frames(lambda f: True)
        warned = [e for e in frame["events"] if "bad record" in e["text"]]
        assert (len(warned), frame["run"]["done"]) == (1, 1)


def test_nonsense_in_the_folder_is_never_green(tmp_path):
    results = tmp_path / "results"
    (results / "day").mkdir(parents=True)
    with JournalWriter.create(results / "day" / "a.rigj", run.header()):
        pass
    (results / "day" / "b.rigj").write_bytes(b"RIGJ0001" + os.urandom(5000))
    (results / "day" / "c.rigj").write_bytes(b"GIF89a")
    (results / "day" / "d.h5").write_bytes(os.urandom(500))
    (results / "day" / "e.rigj").symlink_to("/etc/passwd")
    process, served = serve(results, "--read-only")
    try:
        assert served.stop_token == ""
        served.stop_token = served.watch_token
        frame = served.frames(lambda f: f["word"] != "unknown" or "yet" not in f["reason"])
        assert frame["word"] in ("unknown", "UNSAFE")
        assert frame["may_stop"] is False
        assert served.ask("POST", "/api/stop", **served.bearer())[0] == 403
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


SLOW_LOOK = """
import sys, time
from rig.cli import main
from rig.page import server

def index(state, over):
    print("looking", flush=True)
    over.wait()
    time.sleep(0.5)
    print("looked", flush=True)

server._index = index
sys.argv = ["rig", "page", "--port", "0", "--results", sys.argv[1]]
main()
"""


def test_a_page_ends_only_after_what_reads_files_has(tmp_path: Path) -> None:
    """A thread that Python ends within h5py keeps its lock: the page hung at its end."""
    page = subprocess.Popen(
        [sys.executable, "-c", SLOW_LOOK, str(tmp_path)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert page.stdout is not None
    seen = ""
    while not ("looking" in seen and (found := re.search(r"127\.0\.0\.1:(\d+)/", seen))):
        line = page.stdout.readline()
        assert line, seen
        seen += line
    connection = http.client.HTTPConnection("127.0.0.1", int(found[1]), timeout=60)
    connection.request("GET", "/")  # once it answers, the server has taken the signals over
    connection.getresponse().read()
    connection.close()
    page.send_signal(signal.SIGINT)
    said, _ = page.communicate(timeout=60)
    assert "looked" in said
    assert page.returncode == 130


@pytest.mark.parametrize(("ends", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_page_that_is_ended_under_a_viewer_says_so_without_a_traceback(
    tmp_path: Path, ends: signal.Signals, code: int
) -> None:
    process, page = serve(tmp_path / "results")
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=PATIENCE_S)
    connection.request("GET", "/api/live", headers=page.bearer())
    answer = connection.getresponse()
    assert answer.readline()
    process.send_signal(ends)
    answer.read()  # raises if the answer has no end
    connection.close()
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code
    assert said.strip() in ("", "stopped by Ctrl-C; this command left nothing running")
