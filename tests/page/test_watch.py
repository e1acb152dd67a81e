"""What the page believes of a bench: locks, marks, reports and files that contradict each other."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import recorded_run as run
from test_night import held

from rig.bench.plan import parse_bench
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run
from rig.page.folder import ResultsFolder
from rig.page.frames import Cursor, next_frame
from rig.page.watch import BenchWatch, Stop
from rig.page.word import BenchWord
from rig.run.locks.bench_mark import BenchMark, clear_marks, note_made_safe, write_marks
from rig.run.locks.lock import address_names
from rig.run.locks.lock_holder import LockHolder, NotStoppedError, holder_of, lock_file
from rig.run.locks.shared_folder import VARIABLE

BENCH = """
name = "bench-1"
[fixture]
mounted = "film-clamp"
parked_mm = 5.0
contact_from_mm = 12.0
contact_to_mm = 13.0
[force_sensor]
driver = "me-gsv8"
port = "/dev/ttyUSB{number}"
"""


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of results, on a computer with a shared folder of its own."""
    shared = tmp_path / "shared"
    shared.mkdir(mode=0o700)
    monkeypatch.setenv(VARIABLE, str(shared))
    (tmp_path / "results" / "day").mkdir(parents=True)
    return tmp_path / "results"


def bench_toml(number: int = 0) -> str:
    return BENCH.replace("{number}", str(number))


def journal_in(results: Path, name: str = "a", *, ended: bool = True, number: int = 0) -> Path:
    """Write the journal of a run on the bench of this number."""
    path = results / "day" / f"{name}_sweep_r001.rigj"
    header = run.header(bench_toml=bench_toml(number))
    with JournalWriter.create(path, header) as journal:
        run.take_point(journal, 0)
        if ended:
            journal.end(run.end())
    return path


class Observed:
    """A lock that notes what the next viewer would see, whenever it is released."""

    def __init__(self, watch: BenchWatch):
        self._watch, self.seen = watch, list[tuple[str, bool, bool]]()

    def __enter__(self) -> None:
        pass

    def __exit__(self, *failure: object) -> None:
        watch = self._watch
        begun = watch.view.header is not None and watch.view.end is None
        self.seen.append((watch.word.word, watch.holder is not None, begun))


def words(watch: BenchWatch) -> tuple[str, str]:
    """Have the watch look and read until it has come to the end of what there is."""
    for _ in range(3):
        watch._looked_s = -1e9
        watch.poll()
    return watch.word.word, watch.word.reason


def mark(
    state: str, number: int = 0, report: str = "still pressed", released: bool = False
) -> None:
    names = address_names(parse_bench(bench_toml(number), "bench.toml"))
    found = BenchMark(
        state=state,  # type: ignore[arg-type]
        bench="bench-1",
        time="now",
        user="me",
        report=report,
        released=released,
    )
    write_marks(names, found)


def lock_of(number: int = 0) -> Path:
    (name,) = address_names(parse_bench(bench_toml(number), "bench.toml"))
    return lock_file(name)


def report(path: Path, pid: int, older_s: float = 0.0, **changes: object) -> None:
    """Have the guard of a run's process report, at its end, that the bench is safe."""
    said = {"journal": str(path.resolve()), "run_pid": pid, "safe": True, "stopped": True}
    said |= {"cause": "no sign of life", "file": "a.h5"} | changes
    beside = path.with_suffix(".guard.json")
    beside.write_text(json.dumps(said))
    at_ns = path.stat().st_mtime_ns - round(older_s * 1e9)
    os.utime(beside, ns=(at_ns, at_ns))


def test_a_guards_report_of_an_earlier_attempt_says_nothing_of_this_one(results: Path) -> None:
    path = journal_in(results, ended=False)
    report(path, 4242)
    assert words(BenchWatch(results))[0] == "safe"
    watch = BenchWatch(results)
    with held(path):  # it is resumed by another process, which then dies as well
        words(watch)
    assert words(watch)[0] == "UNSAFE"
    report(path, 4242, older_s=5.0)  # what a page sees that is started only now
    assert words(BenchWatch(results))[0] == "UNSAFE"


def test_the_journal_of_an_earlier_run_that_is_left_over_is_not_the_latest(results: Path) -> None:
    earlier = journal_in(results, "earlier")
    watch = BenchWatch(results)
    words(watch)
    latest = journal_in(results, "latest")
    with held(latest):
        words(watch)
        assert watch.path == latest
    compile_run(latest, retire=True)
    assert not latest.exists()
    words(watch)
    assert watch.path == latest, "the earlier run is shown as the latest"
    newest = journal_in(results, "newest")  # a run that was too short to be seen at work
    words(watch)
    assert watch.path == newest
    assert earlier.exists()


def test_the_file_of_an_earlier_run_that_is_compiled_later_is_not_the_latest(results: Path) -> None:
    earlier = journal_in(results, "earlier", ended=False)
    latest = compile_run(journal_in(results, "latest"), retire=True)
    watch = BenchWatch(results)
    words(watch)
    assert watch._latest.file.path == latest
    recovered = compile_run(earlier)
    assert recovered.stat().st_mtime_ns > latest.stat().st_mtime_ns
    for one in (watch, BenchWatch(results)):
        words(one)
        assert one._latest.file.path == latest
        assert one.path is None


def test_run_files_alone_make_no_bench_green_without_a_look_at_its_marks_and_locks(
    results: Path,
) -> None:
    compile_run(journal_in(results), retire=True)
    watch = BenchWatch(results)
    assert watch.path is None
    assert words(watch)[0] == "safe"
    lock_of().touch()
    with held(lock_of()):
        assert words(watch)[0] == "unknown"
    mark("unsafe")
    assert words(watch)[0] == "UNSAFE"
    mark("stopped")
    assert words(watch) == ("pressed", "still pressed")
    mark("stopped", report="it died; stage_z is at 5.00 mm", released=True)
    assert words(watch)[0] == "safe"
    assert watch.path is None


def test_a_run_on_another_bench_says_nothing_of_the_one_that_is_watched(results: Path) -> None:
    bench = results.parent / "bench.toml"
    bench.write_text(bench_toml(7))
    compile_run(journal_in(results), retire=True)
    assert words(BenchWatch(results, bench))[0] == "unknown"
    bench.write_text(bench_toml())
    assert words(BenchWatch(results, bench))[0] == "safe"
    bench.write_text(bench_toml(7))
    mark("unsafe", 7)
    assert words(BenchWatch(results, bench))[0] == "UNSAFE"


def test_a_shared_folder_that_cannot_be_trusted_is_not_the_same_as_no_marks(results: Path) -> None:
    journal_in(results)
    assert words(BenchWatch(results))[0] == "safe"
    (results.parent / "shared").chmod(0o777)
    assert words(BenchWatch(results))[0] == "unknown"


def test_the_file_of_a_run_that_died_is_no_report_of_a_safe_bench(results: Path) -> None:
    path = journal_in(results, ended=False)
    compile_run(path)
    watch = BenchWatch(results)
    assert words(watch)[0] == "UNSAFE"
    assert watch.path == path
    path.unlink()
    assert words(BenchWatch(results))[0] == "UNSAFE"


def test_of_two_runs_at_once_the_page_stays_with_the_one_that_it_shows(results: Path) -> None:
    first, second = journal_in(results, "a", ended=False), journal_in(results, "b", ended=False)
    watch = BenchWatch(results)
    os.utime(second, (1, 1))
    with held(first, second):
        words(watch)
        assert watch.path == first
        os.utime(second)
        words(watch)
        assert watch.path == first


def test_a_stop_before_the_first_record_is_the_stop_of_the_run_that_appears(results: Path) -> None:
    watch = BenchWatch(results)
    words(watch)
    path = journal_in(results, ended=False)
    with held(path):
        holder = holder_of(path)
        assert holder is not None
        watch.stop = Stop(holder, None)
        words(watch)
        assert watch.stop is not None
        assert watch.stop.journal == path


def test_a_stop_is_over_once_its_run_is_resumed(results: Path) -> None:
    path = journal_in(results, ended=False)
    watch = BenchWatch(results)
    words(watch)
    with held(path):
        holder = holder_of(path)
        assert holder is not None
        watch.stop = Stop(holder, path)
        words(watch)
        assert watch.stop is not None
    with held(path):  # by another process
        words(watch)
        assert watch.stop is None


def test_a_stop_after_the_run_died_says_that_its_guard_makes_the_bench_safe(results: Path) -> None:
    path = journal_in(results, ended=False)
    watch = BenchWatch(results)
    words(watch)
    with pytest.raises(NotStoppedError, match="its guard has not reported yet"):
        watch.ask_to_stop()
    report(path, 4242)
    words(watch)
    with pytest.raises(NotStoppedError, match="no run holds the bench"):
        watch.ask_to_stop()


@pytest.mark.parametrize("ended", [True, False], ids=["exit 7", "its guard has failed"])
def test_a_make_safe_after_the_end_or_the_report_ends_unsafe_but_makes_nothing_green(
    results: Path, ended: bool
) -> None:
    names = address_names(parse_bench(bench_toml(), "bench.toml"))
    path = journal_in(results, ended=False)
    if ended:
        path.unlink()
        with JournalWriter.create(path, run.header(bench_toml=bench_toml())) as journal:
            journal.end(run.end("failed", exit=7))
    else:
        report(path, 4242, safe=False, failures={"generator": "it does not answer"})
    mark("unsafe")
    assert words(BenchWatch(results))[0] == "UNSAFE"
    clear_marks(names)
    assert words(BenchWatch(results))[0] == "UNSAFE", "a mark may be removed by hand"
    note_made_safe(names)
    for written in (path, *path.parent.glob("*.guard.json")):
        before_ns = written.stat().st_mtime_ns
        os.utime(written, ns=(before_ns, time.time_ns() + 10**9))
        assert words(BenchWatch(results))[0] == "UNSAFE", "it was made safe before that"
        os.utime(written, ns=(before_ns, before_ns))
    word, reason = words(BenchWatch(results))
    assert (word, "rig make-safe has stopped all motion" in reason) == ("unknown", True)
    mark("unsafe")
    assert words(BenchWatch(results))[0] == "UNSAFE"
    clear_marks(names)  # as the next run does when it begins
    assert words(BenchWatch(results))[0] == "UNSAFE"


def test_a_guard_that_still_lifts_z_or_could_not_leaves_the_stop_red_and_no_bench_green(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its first report says that everything stands; up to 35 s later it says what is pressed."""
    path = journal_in(results, ended=False)
    watch = BenchWatch(results)
    words(watch)
    watch.stop = Stop(LockHolder(4242, "", True), path)
    monkeypatch.setattr("rig.page.watch.lives", lambda _: False)

    def shown(said: dict[str, object]) -> tuple[bool, bool, str]:
        path.with_suffix(".guard.json").write_text(json.dumps(said))
        words(watch)
        course = watch.course()
        assert course is not None
        assert course.phase == "guard"
        return course.over, course.safe, course.text

    report(path, 4242, pressed="", released=False)
    last = json.loads(path.with_suffix(".guard.json").read_text())
    first = {key: value for key, value in last.items() if key != "file"}
    over, safe, text = shown(first)
    assert (over, safe, watch.word.word) == (False, False, "UNSAFE")
    assert "lifts z" in text
    still = "still pressed at 12.44 mm, 3.9 N; not lifted: the wire is broken"
    assert shown(first | {"pressed": still})[:2] == (False, False)
    over, safe, text = shown(last | {"pressed": still})
    assert (over, safe, watch.word.word) == (True, False, "pressed")
    assert text.count(still) == 1
    lifted = {"pressed": "stage_z was lifted: nothing is pressed at 5.00 mm", "released": True}
    over, safe, text = shown(last | lifted)
    assert (over, safe, watch.word.word) == (True, True, "safe")
    assert lifted["pressed"] in text


def test_a_further_press_counts_and_only_an_explicit_one_reaches_the_process(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = journal_in(results, ended=False)
    watch = BenchWatch(results)
    sent: list[Path] = []

    def signal_to(target: Path, **_: bool) -> LockHolder:
        sent.append(target)
        return holder_of(target) or LockHolder(0, "", False)

    monkeypatch.setattr("rig.page.watch.ask_to_stop", signal_to)
    with held(path):
        words(watch)
        watch.ask_to_stop(lambda target: holder_of(target) or LockHolder(0, "", False))
        again = watch.press_again()
        assert (again is not None and again.presses, sent) == (2, [])
        watch.ask_to_stop()  # for the night: the batch has not ended its run by itself
        watch.ask_to_stop()
        assert (sent, watch.stop is not None and watch.stop.presses) == ([path], 2)


@pytest.mark.parametrize("first_for_the_run_only", [False, True])
def test_of_two_presses_at_the_same_time_the_second_counts_and_what_was_seen_is_kept(
    results: Path, monkeypatch: pytest.MonkeyPatch, first_for_the_run_only: bool
) -> None:
    path = journal_in(results, ended=False)
    watch = BenchWatch(results)
    holder = LockHolder(os.getpid(), "", True)

    def signal_to(target: Path, **_: bool) -> LockHolder:
        """Meanwhile another press has reached the process, which has reacted."""
        watch.stop = Stop(holder, target, run_only=first_for_the_run_only)
        watch.stop.reacted = True
        return holder

    monkeypatch.setattr("rig.page.watch.ask_to_stop", signal_to)
    with held(path):
        words(watch)
        stop = watch.ask_to_stop()
    assert stop is watch.stop
    assert (stop.presses, stop.reacted, stop.run_only) == (2, True, False)


def test_the_word_of_a_journal_that_is_still_read_is_unknown(results: Path) -> None:
    journal_in(results)
    watch = BenchWatch(results)
    watch.poll()  # its END is read, and perhaps more follows
    assert (watch.word.word, watch.word.reason) == ("unknown", "the journal is still being read")
    watch.poll()
    assert watch.word.word == "safe"


def test_no_link_below_the_results_folder_is_followed_and_a_young_listing_is_read_again(
    results: Path,
) -> None:
    elsewhere = results.parent / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "secret.rigj").write_bytes(b"")
    (results / "day" / "runs").symlink_to(elsewhere)
    linked = results.parent / "linked"
    linked.symlink_to(results)
    folder = ResultsFolder(linked)
    assert folder.find(".rigj") == []
    now = time.time_ns()
    journal_in(results)
    os.utime(results / "day", ns=(now, now))
    assert len(folder.find(".rigj")) == 1
    journal_in(results, "b")  # within the step of the file system's clock
    os.utime(results / "day", ns=(now, now))
    assert len(folder.find(".rigj")) == 2


@pytest.fixture
def stopping(results: Path) -> Iterator[tuple[JournalWriter, BenchWatch]]:
    """The journal of a run under way, and a page on which STOP has been pressed."""
    path = results / "day" / "a_sweep_r001.rigj"
    with JournalWriter.create(path, run.header(bench_toml=bench_toml())) as journal:
        journal.sync()
        watch = BenchWatch(results)
        words(watch)
        watch.stop = Stop(LockHolder(os.getpid(), "", True), path)
        yield journal, watch


def noted(journal: JournalWriter, code: str) -> None:
    """Record an event."""
    journal.event({"time": 1.0, "level": "info", "code": code, "message": ""})
    journal.sync()


def test_a_run_without_an_open_point_is_seen_to_react_as_it_makes_the_bench_safe(
    stopping: tuple[JournalWriter, BenchWatch],
) -> None:
    journal, watch = stopping
    for code, reacted in (("calibration", False), ("making-safe", True)):
        noted(journal, code)
        words(watch)
        assert watch.stop is not None
        assert watch.stop.reacted is reacted


def test_a_press_after_the_end_of_a_run_is_red_until_its_process_has_gone(
    stopping: tuple[JournalWriter, BenchWatch], monkeypatch: pytest.MonkeyPatch
) -> None:
    journal, watch = stopping
    watch.stop = None
    journal.end(run.end())
    journal.sync()
    words(watch)
    monkeypatch.setattr(
        "rig.page.watch.ask_to_stop", lambda *_, **__: LockHolder(os.getpid(), "", True)
    )
    watch.ask_to_stop()
    course = watch.course()
    assert course is not None
    # It saves its data, or drives the bench in another attempt that has recorded nothing yet.
    assert (course.phase, course.over, course.safe) == ("asked", False, False)
    assert "had ended before the press" in course.text
    monkeypatch.setattr("rig.page.watch.lives", lambda _: False)
    watch.word = BenchWord("safe", "it reported so")
    course = watch.course()
    assert course is not None
    assert (course.phase, course.over, course.safe) == ("ended", True, True)


def test_another_attempt_by_the_same_process_takes_the_bar_of_an_ended_stop_away(
    stopping: tuple[JournalWriter, BenchWatch],
) -> None:
    journal, watch = stopping
    journal.end(run.end("stopped", exit=143))
    journal.sync()
    words(watch)
    assert watch.stop is not None
    assert watch.stop.over
    noted(journal, "servo")
    words(watch)
    assert (watch.stop, watch.view.end) == (None, None)


def test_a_results_folder_that_is_taken_away_leaves_no_bench_green(results: Path) -> None:
    compile_run(journal_in(results), retire=True)
    watch = BenchWatch(results)
    watch.poll()
    assert watch.word.word == "safe"
    away = results.rename(results.with_name("away"))
    watch.poll()
    assert watch.word.word == "unknown"
    assert watch.word.reason == f"the results folder {results} is not there any more"
    results.write_text("a file in its place")
    watch.poll()
    assert watch.word.word == "unknown"
    results.unlink()
    (results / "day").mkdir(parents=True)
    watch.poll()
    assert watch.word.word == "unknown"
    assert "a_sweep_r001.h5 is not in the results folder any more" in watch.word.reason
    (results / "day").rmdir()
    results.rmdir()
    away.rename(results)
    watch.poll()
    assert watch.word.word == "safe"


def test_a_compiled_runs_journal_may_go(results: Path) -> None:
    """The page followed the journal; its run file says the same."""
    path = journal_in(results)
    watch = BenchWatch(results)
    watch.poll()
    watch.poll()
    compile_run(path, retire=True)
    watch.poll()
    assert not path.exists()
    assert watch.word.word == "safe"


def test_no_viewer_sees_a_run_at_work_with_the_word_of_the_one_before(results: Path) -> None:
    journal_in(results)
    watch = BenchWatch(results)
    assert words(watch)[0] == "safe"
    watch.lock = observed = Observed(watch)  # type: ignore[assignment]
    path = results / "day" / "b_sweep_r002.rigj"
    with JournalWriter.create(path, run.header(bench_toml=bench_toml(0))) as journal:
        run.take_point(journal, 0)
        journal.point_begin(run.POINTS[1], {"time": 1.0})
        journal.sync()
        assert words(watch)[0] == "running"
    seen = [word for word, held, begun in observed.seen if held or begun]
    assert "running" in seen
    assert "safe" not in seen


def test_a_page_that_gets_no_time_to_look_says_so_and_blames_no_journal(tmp_path: Path) -> None:
    watch = BenchWatch(tmp_path)
    watch.poll()
    frame = next_frame(watch, Cursor(), may_stop=False, polled_s=time.monotonic() - 10.0)
    assert frame["word"] == "unknown"
    assert "for 10 s the page's server has not looked at the bench" in frame["reason"]
    assert "too busy" in frame["reason"]
