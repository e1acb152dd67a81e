"""In real time each link falls silent at each kind of request of a trial, for longer than a drive
waits to be fed: every other drive is fed meanwhile, and what is pressed is lifted.

A drive waits for 5 s, and a call on a silent instrument takes 7 s or more. So a drive that were fed
by whoever waits for that instrument would stop where it presses. A busy computer stalls for less.
What a simulated head presses may take a busy computer longer to compute than it lasts: then a roll
does not come to the request, and is skipped.
"""

from __future__ import annotations

import contextlib
import re
import signal

import pytest
from benches import declare_soft_contact
from tiers import mostly_nightly

pytestmark = pytest.mark.stages(
    "festo", because="a line that two drives share is held up by either"
)
PARKED_mm = 5.0
PRESSED_mm = 12.0
SILENT = 'kind = "silence"\n'
"""By itself: one answer is lost."""
FOR_EVER = f"{SILENT}count = 0\n"
PAUSE = f"{SILENT}for_s = 2.0\n"
"""Longer than the drives wait where their time-outs are as `rig simulate` writes them."""
LATE = 'kind = "late"\nby_s = 1.5\n'
SLIDE = 'move = 2\nof = "stage_x"\n'
FIRST_RECORD = "acquisition = 1\nafter_s = 0.5\n"
LATER = "acquisition = 8\n"
"""When the film vibrates under its preload."""
SLIP = ("slip-trial", "plate", "--distance", "1mm", "--speed", "0.5mm/s")
TURN = 'move = 2\nof = "rotary"\n'
"""The roll itself, under the force; the first turn goes to where it begins."""
ROLL = (
    "roll-trial", "semi-spherical-object", "--angle", "2deg", "--turn-speed", "1deg/s",
    "--start=-3mm", "--alignment", "none",
)  # fmt: skip
SWEEP = ("sweep", "film-clamp", "--frequencies", "210,310,410")
STALLS = {
    "slip: daq, a block in the slide": (SLIP, "daq", "WAV", SLIDE, FOR_EVER),
    "slip: daq, the end of the record": (SLIP, "daq", "STOP", FIRST_RECORD, FOR_EVER),
    "slip: x, a look in the slide": (SLIP, "stage_x", "FC3 100", SLIDE, FOR_EVER),
    "slip: x, its stop": (SLIP, "stage_x", "FC16", f"{SLIDE}after_s = 0.5\n", FOR_EVER),
    "slip: z, one look": (SLIP, "stage_z", "FC3 100", SLIDE, SILENT),
    "slip: z, one target": (SLIP, "stage_z", "FC16", SLIDE, SILENT),
    "slip: force, its frames": (SLIP, "force_sensor.stream", "", SLIDE, f"{SILENT}for_s = 8.0\n"),
    # Nothing but its end is asked of a stream that runs, and then nothing is pressed any more.
    "slip: force, the end of its stream": (SLIP, "force_sensor", "", FIRST_RECORD, FOR_EVER),
    "roll: daq, a block in the roll": (ROLL, "daq", "WAV", TURN, FOR_EVER),
    "roll: daq, the end of the record": (ROLL, "daq", "STOP", FIRST_RECORD, FOR_EVER),
    "roll: rotary, a look": (ROLL, "rotary", "get", TURN, FOR_EVER),
    "roll: rotary, its way back": (ROLL, "rotary", "move abs", TURN, FOR_EVER),
    "roll: rotary, its stop": (ROLL, "rotary", "stop", TURN, FOR_EVER),
    "roll: x, a look": (ROLL, "stage_x", "FC3 100", TURN, FOR_EVER),
    "roll: x, its stop": (ROLL, "stage_x", "FC16", TURN, FOR_EVER),
    "roll: z, one look": (ROLL, "stage_z", "FC3 100", TURN, SILENT),
    "roll: z, one target": (ROLL, "stage_z", "FC16", TURN, SILENT),
    "roll: force, its frames": (ROLL, "force_sensor.stream", "", TURN, f"{SILENT}for_s = 8.0\n"),
    "sweep: generator, a frequency": (SWEEP, "generator", "SOUR1:FREQ", LATER, FOR_EVER),
    "sweep: generator, an amplitude": (SWEEP, "generator", "SOUR1:VOLT", LATER, FOR_EVER),
    "sweep: generator, its output": (SWEEP, "generator", "OUTP1", LATER, FOR_EVER),
    "sweep: daq, a record": (SWEEP, "daq", "DIG", LATER, FOR_EVER),
    "sweep: daq, a look": (SWEEP, "daq", "WAV", LATER, FOR_EVER),
    "sweep: z, one look": (SWEEP, "stage_z", "FC3 100", LATER, SILENT),
}
"""Procedure, device, command, moment, and what becomes of its answers."""
PAUSES = {
    "slip: daq, a pause": (SLIP, "daq", "", SLIDE, PAUSE),
    "slip: z, one late answer": (SLIP, "stage_z", "FC3 100", SLIDE, LATE),
    "roll: daq, a pause": (ROLL, "daq", "", TURN, PAUSE),
    "roll: rotary, a pause": (ROLL, "rotary", "", TURN, PAUSE),
    "roll: rotary, one late answer": (ROLL, "rotary", "get", TURN, LATE),
    "roll: z, one late answer": (ROLL, "stage_z", "FC3 100", TURN, LATE),
    "sweep: generator, a pause": (SWEEP, "generator", "", LATER, PAUSE),
    "sweep: daq, a pause": (SWEEP, "daq", "", LATER, PAUSE),
    "sweep: daq, one late answer": (SWEEP, "daq", "WAV", LATER, LATE),
    "sweep: z, one late answer": (SWEEP, "stage_z", "FC3 100", LATER, LATE),
}
"""The same, of what ends by itself; here drives and links wait as `rig simulate` writes it."""
EACH_LINK = (
    "slip: daq, a block in the slide",
    "slip: x, its stop",
    "slip: z, one look",
    "sweep: generator, an amplitude",
    "sweep: z, one late answer",
)
"""Each link that can hold up a drive, and each fate; the walk over others, which mostly waits, is
nightly. A rotary stage that falls silent is in test_slow_links, a force sensor in test_force."""


@pytest.fixture
def serve(rig):
    """Starts a simulated bench in real time; its bench file, as it was written or with longer
    waits."""
    with contextlib.ExitStack() as stack:

        def start(fixture, plan, waits_longer):
            path = rig.folder / "a-bench.toml"
            serving = rig.start(
                "simulate", "--fixture", fixture, "--write", str(path), "--fault", plan,
                "--world-log", str(rig.world_log),
            )  # fmt: skip
            stack.callback(serving.finish)
            stack.callback(serving.send, signal.SIGINT)
            serving.wait_for("Ctrl-C ends it")
            if fixture == "film-clamp":
                declare_soft_contact(path)  # the way down is not what stalls here
            if not waits_longer:
                return path
            text = re.sub(r"(timeout_ms =) \d+", r"\1 5000", path.read_text())
            text = re.sub(r"timeout_s = [0-9.]+", "timeout_s = 7.0", text)
            stages = r"(\[stage_[zx]\][^[]*\ntimeout_s =) 7\.0"
            path.write_text("heartbeat_timeout_s = 60.0\n" + re.sub(stages, r"\1 2.0", text))
            return path

        yield start


@pytest.mark.parametrize("what", mostly_nightly([*STALLS, *PAUSES], EACH_LINK))
def test_no_link_that_falls_silent_starves_another_drive_or_keeps_anything_pressed(
    rig, serve, what
):
    (procedure, fixture, *given), device, command, moment, fate = (STALLS | PAUSES)[what]
    plan = rig.fault(f'[[fault]]\ndevice = "{device}"\ncommand = "{command}"\n{moment}{fate}')
    path = serve(fixture, plan, waits_longer=what in STALLS)
    ticks = () if procedure == "sweep" else ("--tick", "20Hz")
    arguments = (procedure, "--bench", str(path), "--json", "--no-figures", *ticks, *given)
    ended = rig.run(*arguments)
    assert ended.code in (0, 3, 5, 7), ended.stderr
    seen = [e for e in rig.log() if e["what"] in ("fault", "at-rest", "move", "injected")]
    injected = [n for n, e in enumerate(seen) if e["what"] == "injected"]
    busy = "cannot keep" in ended.stderr or "is silent" in ended.stderr
    if busy and not injected:
        pytest.skip("the computer was too busy for the trial to come to that request")
    assert injected, "the link never fell silent"
    rested = [n for n, e in enumerate(seen) if (e["device"], e["what"]) == ("stage_z", "at-rest")]
    pressed = [n for n in rested if seen[n]["value"] > PRESSED_mm - 1.0]
    if busy and not pressed:
        pytest.skip("the computer was too busy: a hold has moved the request to before contact")
    assert pressed, "it was never pressed"
    lifted = next((n for n in rested if n > pressed[-1]), None)
    assert lifted is not None, "it is still pressed"
    assert seen[rested[-1]]["value"] == pytest.approx(PARKED_mm, abs=0.02)
    starved = [e["device"] for e in seen[:lifted] if e["what"] == "fault"]
    assert [name for name in starved if name != device] == []
    if ended.code in (3, 7) and not busy:
        assert device.partition(".")[0] in ended.errors[0], ended.errors
