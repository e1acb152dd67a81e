"""The page in a browser: a run from its approach to its end, and STOP wherever it is pressed."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from typing import Any

import pytest
import recorded_run
from chromium import DRIVER, chromium, note_changes, noted, tab_of, wait_for
from nights import ask, await_answer, folder_of
from selenium.webdriver.common.keys import Keys
from stops import WORLD, State, plan, read_stop
from test_server import Page, serve

from rig.detector import DEFAULT_DETECTOR
from rig.detector.registered import chosen_detector
from rig.files.journal.writer import JournalWriter, read_journal
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile
from rig.processing.detection import detect_trials

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(DRIVER is None, reason="chromedriver is not there"),
]
RED = "rgba(192, 0, 24, 1)"
SLIP = ("slip-trial", "--json", "--no-figures")
LONG = (
    *("sweep", "--json", "--no-figures", "--settling", "5s"),
    *("--frequencies", "160,180,200,220,240"),
)
LONGER = (*LONG[:-1], ",".join(str(hz) for hz in range(100, 400, 5)))
"""60 points, so that it still runs when a slow browser has shown its first one."""
LONG_RUNS = """
[batch]
name = "night"
figures = false
detect = false

[[experiment]]
procedure = "slip-trial"
settings = { trials = 30 }
repeat = 3
"""


@pytest.fixture
def page(rig) -> Iterator[Page]:
    rig.results.mkdir()
    process, served = serve(rig.results)
    yield served
    process.send_signal(signal.SIGINT)
    process.wait(60)


@pytest.fixture(scope="module")
def chrome(tmp_path_factory) -> Iterator[Any]:
    """One browser for all tests: its start takes as long as many of them."""
    with chromium(tmp_path_factory.mktemp("profile")) as started:
        yield started


@pytest.fixture
def browser(page, chrome) -> Iterator[Any]:
    with tab_of(chrome) as opened:
        opened.get(f"http://127.0.0.1:{page.port}/#token={page.stop_token}")
        wait_for(opened, "#word", lambda text: "no run in this folder" in text)
        yield opened
        severe = [line for line in opened.get_log("browser") if line["level"] == "SEVERE"]
        assert [line["message"] for line in severe if "/api/" not in line["message"]] == []


def word(browser: Any, *wanted: str) -> str:
    return wait_for(browser, "#word-text", lambda text: text in wanted)


def course(browser: Any, *wanted: str) -> str:
    return wait_for(browser, "#course", lambda text: text.startswith(wanted))


def colour(browser: Any, what: str) -> str:
    return browser.find_element("css selector", what).value_of_css_property("background-color")


def test_a_slip_trial_is_watched_to_its_end_and_the_values_are_those_of_its_file(rig, browser):
    """In real time, from the approach on."""
    with rig.served("--fixture", "plate", ways="as usual") as path:
        running = rig.start(*SLIP, "--bench", str(path))
        word(browser, "running")
        assert "SIMULATED" in browser.title
        assert "SIMULATED" in browser.find_element("id", "mark").text
        word(browser, "pressed")
        ended = running.finish()
    assert ended.code in (0, 5), ended.stderr  # 5: a busy computer is too late for a valid trial
    wait_for(browser, "#facts", lambda text: f"complete, exit {ended.code}" in text)
    word(browser, "safe")
    with RunFile.open(rig.only("*.h5")) as run:
        waves = list(run.waveforms(stream="force"))
        for channel in ("F_n", "F_t"):
            latest = waves[-1].values(channel)[-1]
            shown = browser.find_element("css selector", f'[data-channel="force.{channel}"] b').text
            assert float(shown) == pytest.approx(latest, abs=5.1e-4)
        facts = browser.find_element("id", "facts").text
        assert f"{len(run.point_ids())} of {run.outcome.points_planned}" in facts
        (trial,) = detect_trials(run, chosen_detector(DEFAULT_DETECTOR))
    slips = [event.time_s for event in trial.events if event.kind == "incipient slip"]
    assert slips
    for time_s in slips:
        said = f"trial-001: incipient slip at {time_s:.3f} s of its record"
        wait_for(browser, "#events", lambda text, said=said: said in text)
    drawn = browser.find_elements("css selector", "#charts canvas")
    assert any("PVDF strips (V)" in one.get_attribute("aria-label") for one in drawn)
    assert {one.get_attribute("role") for one in drawn} == {"img"}


def test_stop_by_key_in_a_slide_is_red_until_the_end_record_and_a_second_press_says_so(
    rig, browser
):
    """In real time, because a run in bench time has made its bench safe before a slow browser shows
    that it was asked."""
    with rig.served("--fixture", "plate", ways="as usual") as path:
        running = rig.start(*SLIP, "--trials", "9", "--bench", str(path))
        word(browser, "pressed")
        note_changes(browser, "#course")
        browser.find_element("tag name", "body").send_keys("ss")
        course(browser, "ended")
        ended = running.finish()
    assert ended.code == 143, ended.stderr
    shown = [(text, colour) for text, colour in noted(browser) if text]
    before = [(text, colour) for text, colour in shown if not text.startswith("ended")]
    assert any("Pressed 2 times" in text for text, _ in before), shown
    assert {colour for _, colour in before} == {RED}, shown
    assert colour(browser, "#course") != RED
    assert rig.only("*.h5").exists()


def test_stop_is_in_reach_on_a_phone_and_a_viewer_without_the_right_cannot_press_it(
    rig, page, tmp_path
):
    with chromium(tmp_path / "narrow", 390, 844) as phone:
        phone.get(f"http://127.0.0.1:{page.port}/#token={page.stop_token}")
        wait_for(phone, "#word", lambda text: "no run" in text)
        assert page.stop_token not in phone.current_url
        for down in (0, 2000):
            phone.execute_script(f"scrollTo(0, {down})")
            box = phone.find_element("id", "stop").rect
            top = box["y"] - phone.execute_script("return scrollY")
            assert 0 <= top <= 844 - box["height"]
            assert box["width"] >= 350
        assert phone.execute_script("return document.documentElement.scrollWidth") <= 390
        phone.find_element("tag name", "body").send_keys(Keys.TAB)
        assert phone.switch_to.active_element.get_attribute("id") == "stop"
        phone.get("about:blank")
        phone.get(f"http://127.0.0.1:{page.port}/#token={page.watch_token}")
        wait_for(phone, "#word", lambda text: "no run" in text)
        assert not phone.find_element("id", "stop").is_enabled()


def test_text_from_files_is_shown_as_text_and_never_becomes_markup(rig, browser):
    hostile = '<img src=x onerror="window.taken=1"><b>bold</b>\x1b]0;taken\x07\u202e'
    day = rig.results / "2026-11-21"
    day.mkdir()
    journal = day / "2026-11-21T22-00-00_sweep_r001.rigj"
    named = recorded_run.header(sample={"name": hostile}, title=hostile, procedure="sweep")
    with JournalWriter.create(journal, named) as writer:
        writer.event(recorded_run.event(message=hostile))
        recorded_run.take_point(writer, 0)
        writer.end(recorded_run.end())
    wait_for(browser, "#facts", lambda text: "<b>bold</b>" in text)
    wait_for(browser, "#events", lambda text: "<b>bold</b>" in text)
    compile_run(journal)
    browser.find_element("css selector", "[data-tab=history]").click()
    wait_for(browser, "#runs", lambda text: "<b>bold</b>" in text)
    browser.find_element("css selector", "#runs tbody tr").click()
    wait_for(browser, "#detail", lambda text: "<b>bold</b>" in text)
    assert browser.find_elements("css selector", "main b:not(#numbers b), main img") == []
    assert browser.execute_script("return window.taken") is None
    for width in (1280, 390, 320):
        size = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 600}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        for tab in ("now", "night", "history"):
            browser.find_element("css selector", f"[data-tab={tab}]").click()
            wide = browser.execute_script("return document.documentElement.scrollWidth")
            assert wide <= width, tab


def test_a_run_has_its_time_with_the_zone_and_what_is_simulated_is_marked_in_the_title(
    rig, browser
):
    """Also where only the latest run's file is left."""
    path = rig.results / "2026-11-21" / "2026-11-21T22-00-00_sweep_r001.rigj"
    path.parent.mkdir()
    recorded_run.write_run(path)
    wait_for(browser, "#facts", lambda text: "2026-11-21 22:00:00+01:00" in text)
    wait_for(browser, "#clock", lambda text: bool(re.search(r"\d\d:\d\d:\d\d[+-]\d\d:\d\d$", text)))
    compile_run(path, retire=True)
    browser.find_element("css selector", "[data-tab=history]").click()
    wait_for(browser, "#runs", lambda text: "2026-11-21 22:00:00+01:00" in text)
    late, served = serve(rig.results)
    try:
        browser.get(f"http://127.0.0.1:{served.port}/#token={served.watch_token}")
        wait_for(browser, "#facts", lambda text: "latest run" in text)
        assert browser.title.startswith("SIMULATED ")
    finally:
        late.kill()
        late.wait()


def test_without_scripts_the_page_says_so_and_offers_no_stop(page, tmp_path):
    with chromium(tmp_path / "plain") as plain:
        plain.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
        plain.get(f"http://127.0.0.1:{page.port}/#token={page.stop_token}")
        assert "needs JavaScript" in plain.find_element("tag name", "noscript").text
        assert not plain.find_element("id", "stop").is_enabled()


def test_a_run_that_hangs_is_reported_as_hanging_and_its_guard_has_the_last_word(rig, browser):
    running = rig.start(*LONG, fresh=True)
    running.wait_for("^1/5 ")
    os.kill(running.process.pid, signal.SIGSTOP)
    browser.find_element("id", "stop").click()
    stated = course(browser, "hanging")
    assert "kills it after 5 s" in stated
    assert colour(browser, "#course") == RED
    stated = wait_for(browser, "#course", lambda text: "had to act" in text)
    assert "no sign of life" in stated
    assert running.finish().code == -signal.SIGKILL


def test_a_killed_run_is_never_green_before_its_guard_has_reported(rig, browser):
    running = rig.start(*LONGER, fresh=True)
    wait_for(browser, "#facts", lambda text: re.search(r"point\n(?!0|1 )\d+ of", text) is not None)
    note_changes(browser, "#word")
    running.send(signal.SIGKILL)
    wait_for(browser, "#word", lambda text: "guard reported" in text or "still pressed" in text)
    seen = [text for text, _ in noted(browser)]
    green = [text for text in seen if text.startswith("safe")]
    assert all("its guard reported" in text for text in green), seen
    facts = wait_for(browser, "#facts", lambda text: "sweep (interrupted)" in text)
    assert "time left\ninterrupted" in facts
    (journal,) = rig.results.glob("*/*.rigj")
    assert f"point\n{len(read_journal(journal).kept_ids())} of 60" in facts


def test_a_page_that_is_killed_costs_its_run_nothing_and_a_late_one_shows_all_of_it(
    rig, page, tmp_path
):
    killed, _ = serve(rig.results)
    running = rig.start(*LONG, fresh=True)
    running.wait_for("^1/5 ")
    killed.kill()
    killed.wait()
    late, served = serve(rig.results)
    try:
        with chromium(tmp_path / "late") as browser:
            browser.get(f"http://127.0.0.1:{served.port}/#token={served.watch_token}")
            wait_for(browser, "#facts", lambda text: "sweep" in text)
            assert running.finish().code == 0
            wait_for(browser, "#facts", lambda text: "5 of 5" in text)
    finally:
        late.kill()
        late.wait()


def test_a_journal_that_is_cut_under_the_page_is_said_and_is_not_green(rig, browser):
    path = rig.results / "2026-11-22" / "2026-11-22T10-00-00_sweep_r001.rigj"
    path.parent.mkdir()
    writer = recorded_run.start_writer(path)
    try:
        wait_for(browser, "#facts", lambda text: "sweep" in text)
        # A run that writes on may have made up for the cut before the page looks again; and half of
        # the file may be more than the page has read. The header it has read.
        writer.send_signal(signal.SIGSTOP)
        os.truncate(path, 100)
        wait_for(browser, "#events", lambda text: "was cut to" in text)
        assert not browser.find_element("id", "word").text.startswith("safe")
    finally:
        writer.kill()
        writer.wait()


APPROACH = State((), 'move = 3\nof = "stage_z"\n', 0.5)
"""A sweep's way down to the film, half a second after its begin."""


def test_stop_in_an_approach_ends_it_before_anything_is_pressed(rig, browser):
    bench = rig.folder / "bench.toml"
    serving = rig.start(
        "simulate", "--write", str(bench), "--world", rig.world(WORLD),
        "--world-log", str(rig.world_log), "--fault", rig.fault(plan(APPROACH, "SIGTERM")),
    )  # fmt: skip
    serving.wait_for("Ctrl-C ends it")
    running = rig.start("sweep", "--bench", str(bench), "--json", "--no-figures")
    rig.await_world("injected")
    word(browser, "running")
    browser.find_element("id", "stop").click()
    course(browser, "ended")
    ended = running.finish()
    serving.send(signal.SIGINT)
    assert serving.finish().code == 0
    assert ended.code == 143, ended.stderr
    stop = read_stop(rig.log())
    assert stop.moving == ("stage_z",)
    assert stop.clear_s is not None
    assert True not in rig.outputs(), "the film was never loaded"
    word(browser, "safe")


def test_stop_in_a_hold_ends_the_run_that_waits(rig, browser):
    running = rig.start(*SLIP, "--trials", "30", fresh=True)
    word(browser, "pressed")
    running.send(signal.SIGTSTP)  # Ctrl-Z: the bench is made safe, and the run waits
    word(browser, "holding")
    browser.find_element("id", "stop").click()
    course(browser, "ended")
    assert running.finish().code == 143
    word(browser, "safe")


def test_a_stop_whose_run_is_then_killed_is_red_until_the_guards_report(rig, browser):
    running = rig.start(*LONG, fresh=True)
    running.wait_for("^1/5 ")
    os.kill(running.process.pid, signal.SIGSTOP)
    browser.find_element("id", "stop").click()
    course(browser, "asked", "hanging")
    running.send(signal.SIGKILL)
    stated = wait_for(browser, "#course", lambda text: text.startswith("guard"))
    if "no report yet" in stated:
        assert colour(browser, "#course") == RED
    wait_for(browser, "#course", lambda text: "had to act" in text)
    assert running.finish().code == -signal.SIGKILL
    word(browser, "safe")


def test_stop_after_kill_9_sends_nothing_and_says_who_makes_the_bench_safe(rig, browser):
    running = rig.start(*LONG, fresh=True)
    running.wait_for("^1/5 ")
    word(browser, "running", "pressed")
    running.send(signal.SIGKILL)
    assert running.finish().code == -signal.SIGKILL
    browser.find_element("id", "stop").click()
    stated = wait_for(browser, "#notice", lambda text: text != "")
    assert "its guard has not reported yet" in stated or "no run holds the bench" in stated
    assert re.search(r" \(asked at \d\d:\d\d:\d\d by this browser's clock\)$", stated), (
        "it stays when a run begins"
    )
    word(browser, "safe")
    assert "its guard reported" in browser.find_element("id", "word").text


ADDING = """
const own = take;
window.added = {};
take = frame => own({...frame, ...added});
"""
"""Has the page take what a test adds to every frame."""


def test_a_make_safe_after_a_stop_is_shown_and_a_later_stop_takes_its_place(browser):
    """The result of "Make safe" was hidden by the stop before it."""
    browser.execute_script(ADDING)
    stop = {
        "phase": "ended", "text": "the bench is UNSAFE", "over": True, "safe": False,
        "asked": "10:00:00", "presses": 1, "since_s": 100.0,
    }  # fmt: skip
    shown = {"stop": stop, "can_make_safe": True, "word": "unknown"}
    browser.execute_script("added = arguments[0];", shown)
    course(browser, "ended")
    for code, word_shown, colour_is_red in ((7, "UNSAFE", True), (0, "unknown", False)):
        said = {"ok": True, "exit": code, "text": "what make-safe said"}
        answering = "const [said, word] = arguments; change = async () => said; added.word = word;"
        browser.execute_script(answering, said, word_shown)
        browser.find_element("id", "make-safe").click()
        wait_for(browser, "#course", lambda text, code=code: f"said (exit {code})" in text)
        wait_for(
            browser,
            "#course",
            lambda _, red=colour_is_red: (colour(browser, "#course") == RED) is red,
        )
    browser.execute_script("added.word = 'pressed';")
    wait_for(browser, "#course", lambda _: colour(browser, "#course") == RED)
    browser.execute_script("added.stop.since_s = 0.0;")
    course(browser, "ended")
    assert colour(browser, "#course") == RED


def test_a_press_while_a_stop_is_under_way_is_for_it_alone_and_the_one_after_it_is_fresh(browser):
    """A second press reached the whole batch if the run had just ended."""
    browser.execute_script(ADDING)
    stop = {
        "phase": "asked", "text": "", "over": False, "safe": False, "asked": "10:00:00",
        "presses": 1, "since_s": 0.3,
    }  # fmt: skip
    browser.execute_script("added.stop = arguments[0];", stop)
    course(browser, "asked")
    posted = "window.posted = []; const own_ask = ask; ask = (path, options = {}) => {"
    posted += " if (options.method) posted.push(options.body); return own_ask(path, options); };"
    browser.execute_script(posted)
    browser.find_element("id", "stop").click()
    wait_for(browser, "#notice", lambda text: "press again to stop what is at work now" in text)
    browser.find_element("id", "stop").click()  # the frames still show the stop
    wait_for(browser, "#notice", lambda text: "no run holds the bench" in text)
    assert browser.execute_script("return posted") == ['{"what":"again"}', "{}"]
    runs = {"queued": 1, "running": 0, "done": 0, "failed": 0, "set-aside": 0}
    night = {"running": True, "name": "night", "runs": runs}
    batch_runs = "added.stop = null; night = arguments[0]; readNight = () => {};"
    browser.execute_script(batch_runs, night)
    wait_for(browser, "#course", lambda text: not text)
    browser.find_element("id", "stop").click()
    assert browser.find_element("id", "ask").is_displayed(), "a choice is never left out"


def queue_of(rig: Any) -> list[tuple[int, str]]:
    """Number and state of the runs of the one batch."""
    return ask(folder_of(rig.results), "SELECT number, state FROM run ORDER BY number")


def test_in_a_batch_this_run_is_stopped_and_the_next_follows_until_the_night_is_stopped(
    rig, browser
):
    (rig.folder / "night.toml").write_text(LONG_RUNS)
    running = rig.start("batch", "run", "night.toml", fresh=True)
    word(browser, "pressed")
    wait_for(browser, "#facts", lambda text: "night: 0 of 3 runs over" in text)
    browser.find_element("tag name", "body").send_keys("s")
    dialog = browser.find_element("id", "ask")
    assert dialog.is_displayed()
    dialog.find_element("css selector", "[value=run]").click()
    await_answer(folder_of(rig.results), "SELECT state FROM run WHERE number = 1", "failed")
    await_answer(folder_of(rig.results), "SELECT state FROM run WHERE number = 2", "running")
    wait_for(browser, "#facts", lambda text: "night: 1 of 3 runs over" in text)
    word(browser, "pressed")
    browser.find_element("id", "stop").click()
    browser.find_element("css selector", "#ask [value=night]").click()
    ended = running.finish()
    assert ended.code == 143, ended.stderr
    states = dict(queue_of(rig))
    assert states[1] == "failed"
    assert states[2] != "done"
    assert states[3] == "queued"
    word(browser, "safe")


CUT_NUMBERS = """
const cut = [];
for (const [name, {plot}] of Object.entries(charts)) {
  const axis = plot.axes[1];
  plot.ctx.font = axis.font[0];
  for (const text of axis._values) {
    const width = plot.ctx.measureText(text ?? "").width / devicePixelRatio;
    if (width + axis.ticks.size + axis.gap > axis._size) cut.push(`${name}: ${text}`);
  }
}
return cut;
"""


DRAWN = """
return Object.entries(charts).map(([id, {plot}]) => [id, plot.scales.x.min, plot.scales.x.max,
  plot.scales.y.min, plot.scales.y.max, JSON.stringify(plot.data)]);
"""


def test_small_voltages_keep_their_sign_and_a_paused_view_its_charts_when_it_gets_dark(
    rig, browser
):
    day = rig.results / "2026-11-21"
    day.mkdir()
    with JournalWriter.create(
        day / "2026-11-21T22-00-00_sweep_r001.rigj", recorded_run.header()
    ) as writer:
        writer.event(recorded_run.event() | {"level": "error", "code": "failure"})
        writer.point_begin(recorded_run.POINTS[0], {"time": 0.0})
        writer.stream(recorded_run.state(scale=[7e-9, 7e-9], offset=[0.0, 0.0]))
        writer.block(0, 0, 0.1, recorded_run.samples(0))
        writer.point_keep(recorded_run.POINTS[0], recorded_run.reading(0))
        writer.end(recorded_run.end(points=1))
    wait_for(browser, "#facts", lambda text: "complete" in text)
    browser.execute_script("draw(last.run)")
    assert browser.execute_script("return charts.daq.plot.axes[1]._values.some(v => v < 0)")
    assert browser.execute_script(CUT_NUMBERS) == []
    browser.find_element("id", "pause").click()
    wait_for(browser, "#pause", lambda text: text == "Continue the view")
    before = browser.execute_script(DRAWN)
    browser.execute_script(
        "const now = series.daq; now.k.push(now.k[now.k.length - 1] + 9); last.run.last_s += 9;"
        "for (const values of [...now.low, ...now.high]) values.push(1.0);"
        "charts.daq.box.dataset.old = 'yes';"
    )
    dark = {"name": "prefers-color-scheme", "value": "dark"}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [dark]})
    redrawn = "return charts.daq.box.dataset.old !== 'yes'"
    wait_for(browser, "#pause", lambda _: browser.execute_script(redrawn))
    assert browser.execute_script(DRAWN) == before, "and not what came since beside old numbers"
    assert browser.execute_script("return document.querySelectorAll('#charts canvas').length") == (
        len(before)
    )


def test_what_is_being_read_of_the_night_stays_in_its_place_when_it_is_read_again(browser):
    """Every 5 s a long list went back to its first run."""
    night = {
        "name": "night", "state": "running", "running": True, "simulated": True,
        "runs": {"queued": 100, "running": 0, "done": 0, "failed": 0, "set-aside": 0},
        "retried": 0, "holds": 0, "presses": 0, "left_s": 1.0, "drift": [], "events": [],
        "bench_warnings": [],
        "lists": {"queued": [{"run": n, "condition": "sweep-001"} for n in range(100)]},
    }  # fmt: skip
    browser.execute_script("night = arguments[0]; readNight = () => {};", night)
    browser.find_element("css selector", "[data-tab=night]").click()
    browser.execute_script("showNight(); document.querySelector('.wide[data-of]').scrollTop = 300;")
    browser.execute_script("night.lists.queued.shift(); showNight();")
    assert (
        browser.execute_script("return document.querySelector('.wide[data-of]').scrollTop") == 300
    )


def test_a_view_of_the_night_that_could_not_be_read_again_says_that_it_is_old(browser):
    """It stayed as it was, without a mark, for as long as the server answered with an error."""
    browser.execute_script("window.fails = true; window.own_ask = ask;")
    browser.execute_script(
        "ask = (path, options) => path === '/api/night' && fails"
        " ? Promise.resolve({ok: false, status: 500}) : own_ask(path, options);"
    )
    browser.find_element("css selector", "[data-tab=night]").click()
    shown = wait_for(browser, "#night-body", lambda text: "This view is old" in text)
    assert shown.endswith("the page's server answered with an error (500).")
    browser.execute_script("fails = false; readNight();")
    wait_for(browser, "#night-body", lambda text: text == "There is no batch in this folder.")
    browser.execute_script(
        "window.asked_for = 0; ask = () => (++asked_for, new Promise(() => {}));"
    )
    browser.execute_script("readNight(); readNight(); readNight();")
    assert browser.execute_script("return asked_for") == 1, "STOP would wait for a connection"


def test_the_chosen_run_of_the_history_is_not_hidden_under_the_state_of_the_bench(rig, browser):
    day = rig.results / "2026-11-21"
    day.mkdir()
    header = recorded_run.header(settings={f"n{n}": n for n in range(100)}, setting_units={})
    journal = day / "2026-11-21T22-00-00_sweep_r001.rigj"
    with JournalWriter.create(journal, header) as writer:
        recorded_run.take_point(writer, 0)
        writer.end(recorded_run.end())
    compile_run(journal, retire=True)
    browser.find_element("css selector", "[data-tab=history]").click()
    wait_for(browser, "#runs", lambda text: "complete" in text)
    browser.find_element("css selector", "#runs tbody tr").click()
    wait_for(browser, "#detail", lambda text: "n99" in text)
    gap = """
    const bottom = id => document.getElementById(id).getBoundingClientRect();
    return [scrollY, bottom("detail").top - bottom("top").bottom];
    """
    wait_for(browser, "#detail", lambda _: browser.execute_script(gap)[0] > 100)
    wait_for(browser, "#detail", lambda _: 0 <= browser.execute_script(gap)[1] < 30)
