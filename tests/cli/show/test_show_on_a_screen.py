"""`rig show FILE` fits a terminal of 24 lines and 80 columns, prompt included, for every kind of
file, and names what matters there."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest
import recorded
import recorded_run
from tiers import mostly_nightly

from procedures.slip_trial import SlipTrial
from procedures.slip_trial.settings import SlipTrialSettings
from rig.cli.show.digest import _brief, of_run
from rig.cli.show.results import recomputed
from rig.cli.show.screen import Section, on_a_screen
from rig.core.validated import stored_settings
from rig.files.describe import describe
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile

LINES, COLUMNS = 23, 80


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run files of the simulated bench."""
    return recorded.unpack(tmp_path_factory.mktemp("runs"))


def shown(rig: Any, *names: Path | str) -> str:
    """What `rig show` prints, whose size is checked."""
    done = rig.run("show", *map(str, names))
    assert done.code == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) <= LINES, done.stdout
    assert max(map(len, lines)) <= COLUMNS, done.stdout
    assert "status: " in done.stdout or "detector: " in done.stdout or "program: " in done.stdout
    return str(done.stdout)


# --- files of the repository ----------------------------------------------------------------------


def test_trials_show_validity_friction_and_what_is_assumed(rig: Any, folder: Path) -> None:
    said = shown(rig, folder / recorded.TWO_SLIDES)
    assert "status: complete, 2 of 2 trials" in said
    assert "speed_mm_s 0.7, distance_mm 0.25" in said
    assert "  valid: 2 of 2 trials" in said
    assert "  static friction: 0.6" in said
    assert " ± " in said
    assert "ASSUM" in said


def test_results_are_in_brief_where_the_package_of_the_detector_is_not_installed(
    folder: Path,
) -> None:
    """Its slips and the grip's answers are in the file; only a new run needs the package."""
    with RunFile.open(folder / recorded.TWO_SLIDES) as run:
        settings = run.header.settings | {"detector": "of-another-laboratory"}
        header = run.header.model_copy(update={"settings": settings})
        readings = run.readings()
    with pytest.raises(ValueError, match="is not a detector"):
        SlipTrialSettings(detector="of-another-laboratory")
    assert stored_settings(SlipTrialSettings, settings).detector == "of-another-laboratory"
    found = recomputed(header, readings)
    assert found is not None
    assert _brief(header, SlipTrial, found)[0].startswith("valid: 2 of 2 trials")


def test_a_roll_and_a_sweep_show_theirs(rig: Any, folder: Path) -> None:
    said = shown(rig, folder / recorded.ROLL)
    assert "  strip 1, peak in the roll: " in said
    said = shown(rig, folder / recorded.SWEEP)
    assert "film-clamp, simulated film 0" in said
    assert "loads_N 0.5; 2" in said


def test_a_processed_file_shows_its_detector_and_the_slips(rig: Any, folder: Path) -> None:
    done = rig.run("detect", "--json", str(folder / recorded.TWO_SLIDES), "--to", str(rig.folder))
    assert done.code == 0, done.stderr
    said = shown(rig, *rig.folder.glob("*.h5"))
    assert "detector: paper-hp 3" in said
    assert "parameters: all at their defaults" in said
    assert "  trial-001: incipient slip at " in said


def test_a_run_that_was_killed_shows_how_to_go_on(rig: Any) -> None:
    with JournalWriter.create(rig.folder / "run.rigj", recorded_run.header()) as writer:
        recorded_run.take_point(writer, 0)
    said = shown(rig, "run.rigj")
    assert "status: failed (" in said
    assert "resume with: rig resume run.rigj" in said


def test_figures_are_offered_only_where_they_can_be_drawn(rig: Any) -> None:
    with JournalWriter.create(rig.folder / "run.rigj", recorded_run.header()) as writer:
        recorded_run.take_point(writer, 0)
    compile_run(rig.folder / "run.rigj")
    assert "--figures" not in shown(rig, "run.rigj")
    assert "--figures draws the figures again" in shown(rig, "run.h5")
    with JournalWriter.create(rig.folder / "none.rigj", recorded_run.header()):
        pass  # no point was completed
    compile_run(rig.folder / "none.rigj")
    assert "--figures" not in shown(rig, "none.h5")


def test_the_line_to_resume_is_whole_however_long_the_path_is(rig: Any) -> None:
    folder = rig.folder / "a folder of measurements" / ("deep-" * 20)
    folder.mkdir(parents=True)
    with JournalWriter.create(folder / "run.rigj", recorded_run.header()) as writer:
        recorded_run.take_point(writer, 0)
    path = str(folder / "run.rigj")
    done = rig.run("show", path)
    assert done.code == 0, done.stderr
    last = done.stdout.splitlines()[-1]
    assert shlex.split(last.removeprefix("resume with: ")) == ["rig", "resume", path]
    assert sum(-(-max(1, len(line)) // 80) for line in done.stdout.splitlines()) <= 23


def test_nothing_that_is_shown_leaves_the_whole_description(rig: Any, folder: Path) -> None:
    everything = rig.run("show", "--all", str(folder / recorded.TWO_SLIDES)).stdout
    run = "file procedure title start_time status points_done points_planned duration_s attempt"
    for name in f"{run} simulated bench fixture program settings results results_by".split():
        assert f"\n{name}:" in f"\n{everything}", name
    for name in ("mean_touch_gain_1_dB", "force_zero_N", "put_in", "standard_errors", "tick_Hz"):
        assert f"\n  {name}:" in everything, name


def test_everything_has_a_line_for_each_column_and_stream(rig: Any, folder: Path) -> None:
    file = str(folder / recorded.TWO_SLIDES)
    everything = rig.run("show", "--all", file).stdout
    columns, streams = everything.split("\ncolumns:\n")[1].split("streams:\n")
    assert "  speed: Speed of the slide (mm/s)\n" in columns
    assert "  force: F_n, F_t, F_y in N, 1000 Hz (Normal force, " in streams
    assert "  strips: strip_1, strip_2 in V, 10000 Hz (" in streams
    assert "  position: z, x, z_commanded, x_commanded in mm (" in streams
    as_json = json.loads(rig.run("show", "--json", file).stdout)
    with RunFile.open(folder / recorded.TWO_SLIDES) as run:
        assert list(as_json["columns"]) == run.columns()
        assert {sample.stream for sample in run.waveforms()} == {
            name for name, stream in as_json["streams"].items() if stream["recorded"]
        }
    assert as_json["streams"]["force"]["rate_Hz"] == 1000
    assert as_json["streams"]["force"]["unit"] == "N"


def test_a_journal_has_the_same_columns_and_streams_as_its_run_file(rig: Any) -> None:
    with JournalWriter.create(rig.folder / "run.rigj", recorded_run.header()) as writer:
        recorded_run.take_point(writer, 0)
        writer.end(recorded_run.end("stopped", 1))
    assert rig.run("recover", "run.rigj").code == 0
    journal, file = (
        json.loads(rig.run("show", "--json", name).stdout) for name in ("run.rigj", "run.h5")
    )
    for name in ("columns", "streams"):
        assert journal[name] == file[name] != {}


def test_a_heading_is_whole_where_lines_are_left() -> None:
    status = "status: failed (" + "1e+308 Hz is not below half the rate, " * 3 + "sample faster)"
    results = [f"value {number}" for number in range(5)]
    lines = on_a_screen(["file: a", status], [Section("results", results, 0)], ["the end"])
    assert lines[0] == "file: a"
    assert " ".join(line.strip() for line in lines[1:3]) == status
    full = on_a_screen(["file: a", status], [Section("results", results * 5, 0)], ["the end"])
    assert full[1].endswith("...")
    assert len(full) == LINES


@pytest.mark.thorough
def test_an_imported_recording_states_units_in_words(rig: Any) -> None:
    rows = "\n".join(f"{n};{n % 7};{n % 5}" for n in range(300))
    (rig.folder / "rec.csv").write_text(f"n;left [mV];right [mV]\n{rows}\n")
    done = rig.run(
        "import",
        "rec.csv",
        "--channels",
        "v_1=2,v_2=3",
        "--scale",
        "v_1=1mV,v_2=1mV",
        "--rate",
        "1000",
    )
    assert done.code == 0, done.stderr
    said = shown(rig, rig.only("*.h5"))
    assert "scale.v_1 0.001 V" in said
    assert "text written with semicolon, decimal point" in " ".join(said.split())


def test_sections_share_what_is_left_by_their_rank() -> None:
    long = " ".join(["word"] * 40)
    sections = [Section("settings", [long] * 9, 1), Section("results", [long] * 30, 0)]
    lines = on_a_screen(["file: a", "title: \x1b[2J" + long], sections, ["foot " * 90])
    assert len(lines) == LINES
    assert max(map(len, lines)) <= COLUMNS
    assert "\x1b" not in "".join(lines)
    results = lines.index("results:")
    assert lines[results - 1] == "  ... and 8 more; --all shows them"
    assert lines[-3].startswith("  ... and ")
    results = Section("results", [f"value {n}" for n in range(20)], 0)
    lines = on_a_screen([], [results, Section("warnings", [3 * long], 3)], [])
    assert len(lines) == LINES
    assert "  value 19" in lines, "a long warning takes no line from the results"
    assert lines[-1].endswith("...")
    whole = on_a_screen([], [Section("warnings", [long], 3)], [])
    assert whole[0] == "warnings:"
    assert " ".join(line.strip() for line in whole[1:]) == long


def test_figures_that_cannot_be_written_are_a_failure(rig: Any, folder: Path) -> None:
    done = rig.run("show", str(folder / recorded.TWO_SLIDES), "--figures-to", "/proc/none")
    assert done.code == 5
    assert "warning: no figure was drawn: /proc/none cannot be written to" in done.stderr


def test_why_a_trial_is_invalid_comes_before_other_warnings(folder: Path) -> None:
    """A screen has no room for all warnings of a long run."""
    with RunFile.open(folder / recorded.TWO_SLIDES) as run:
        header = run.header
        what = describe(run.path, header, run.outcome)
    invalid = "trial-002 is invalid: F_n was 7 % off"
    lines = of_run(what | {"warnings": ["w" * 75, "v" * 75, invalid]}, header, None, "", {})
    assert lines[lines.index("warnings:") + 1] == f"  {invalid}"


def test_values_of_another_procedure_are_shown_one_by_one(rig: Any, tmp_path: Path) -> None:
    """Its package is not installed."""
    header = recorded_run.header(procedure="creep")
    with JournalWriter.create(rig.folder / "run.rigj", header) as writer:
        for number in range(5):
            recorded_run.take_point(writer, number)
        writer.end(recorded_run.end())
    assert "status: complete, 5 of 5 points" in shown(rig, "run.rigj")


def test_a_file_of_a_procedure_that_is_not_installed_says_so_and_calls_no_value_true(
    rig: Any,
) -> None:
    header = recorded_run.header(procedure="creep", procedure_package="lab")
    with JournalWriter.create(rig.folder / "run.rigj", header) as writer:
        recorded_run.take_point(writer, 0)
        writer.end(recorded_run.end())
        writer.results(
            {
                "program": header["program"], "values": {"mean_static_friction": 0.6798},
                "put_in": {"mean_static_friction": 0.8},
            }
        )  # fmt: skip
    compile_run(rig.folder / "run.rigj")
    said = shown(rig, "run.h5")
    assert "procedure: creep of lab is not installed here" in said
    assert "static friction: 0.6798 (put into the simulation: 0.8)" in said
    drawn = rig.run("show", "--figures", "run.h5")
    assert drawn.code == 5
    assert drawn.stdout == said
    assert drawn.stderr == (
        "no figure was drawn: run.h5: procedure creep of lab is not installed here\n"
    )
    journal = rig.run("show", "--pdf", "run.rigj")
    assert journal.code == 5
    assert journal.stderr == (
        "no figure was drawn: run.rigj: a journal has no figures, its run file has\n"
    )


# --- files that the program writes now ----------------------------------------------------------


@pytest.mark.parametrize(
    "loads", mostly_nightly(["1", "1,5"], thorough=["1,5"]), ids=["one load", "two loads"]
)
def test_a_whole_sweep_fits(rig: Any, loads: str) -> None:
    short = ("--coarse-per-decade", "4", "--fine-per-decade", "12")
    done = rig.sweep(*short, "--loads", loads)
    assert done.code == 0, done.stderr
    said = shown(rig, done.object["file"])
    for text in (
        "  20 dB/decade (stress rate): holds within ±0.05 dB/decade\n",
        "  slope without the fitted low-pass: 20.0",
        " dB re 1 V/N (true value: ",
        " dB deep, Q ",
        "(true value: 20)",
        "  level b at 1 Hz: ",
        "  corner: 145",
        "  joint fit: χ² = ",
    ):
        assert text in said
    assert said.count("  notch: ") == 3
    assert ("on the load: holds within ±0.05 dB/decade, ±0.1 dB" in said) == ("," in loads)


@pytest.mark.thorough
def test_a_part_of_the_range_says_what_it_cannot_decide(rig: Any) -> None:
    done = rig.sweep("--lowest", "20", "--highest", "2000", "--points-per-half-width", "0")
    said = shown(rig, done.object["file"])
    assert "cannot be decided by these data (" in said
    assert " d.o.f., poor: the ± above mean little" in said


@pytest.mark.thorough
@pytest.mark.parametrize(
    "arguments",
    [("slip-trial", "--distance", "0.3", "--force-error-rms", "0.001"), ("path-trial",)],
    ids=["an invalid slip trial", "a path trial"],
)
def test_a_trial_fits(rig: Any, arguments: tuple[str, ...]) -> None:
    done = rig.run(*arguments, "--rest", "100ms", "--no-figures", "--json")
    assert done.code == (0 if arguments == ("path-trial",) else 5), done.stderr
    said = shown(rig, done.object["file"])
    assert "  valid: " in said
    assert ("invalid" in said) == (done.code == 5)
