"""``rig score``: refusals before anything is computed, and tables, files and figures after."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import typer
from strips_file import slip_file
from typer.testing import CliRunner

from rig.cli.commands.score import score
from rig.cli.commands.score_report import reserved
from rig.core.errors import ConfigurationError
from rig.evaluation.scoring.outcomes import Truth
from rig.evaluation.wire import judging
from rig.evaluation.wire.kinds import drawn
from rig.evaluation.wire.making import MadeTrial
from rig.evaluation.wire.record import WireRecord
from rig.physics.population import PopulationSettings

app = typer.Typer(pretty_exceptions_enable=False)
app.command()(score)

SKIN = {"ridges": 3, "elements_per_ridge": 3}
SHORT = {
    "ridge": 2,
    "skin": SKIN,
    "normal_force_N": {"low": 1.0, "high": 1.5},
    "speed_mm_s": {"low": 4.0, "high": 6.0},
    "loading_s": {"low": 0.04, "high": 0.05},
    "rest_s": {"low": 0.03, "high": 0.04},
    "roll_s": {"low": 0.1, "high": 0.12},
    "start_x_mm": {"low": -0.3, "high": 0.3},
    "radius_mm": {"low": 5.0, "high": 10.0},
    "static_coefficient": {"low": 1.0, "high": 1.2},
    "held_s": 0.05,
}


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RIG_CACHE", str(tmp_path / "cache"))


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(each) for each in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def refused(*arguments: object) -> str:
    """What stderr says of a command line that is refused."""
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    return line


def table(file: Path) -> list[dict[str, str]]:
    with file.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture
def population(tmp_path: Path) -> Path:
    file = tmp_path / "population.json"
    file.write_text(json.dumps(SHORT))
    return file


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--seeds", "0:10"], "seeds 0:10 are reserved for tuning (below 1000000)"),
        (["--seeds", "999990:1000010"], "lie on both sides of 1000000"),
        (
            ["--seeds", "1000000:1000010", "--tuning"],
            "are reserved for reporting (from 1000000 on)",
        ),
        (["--seeds", "10"], "--seeds 10: not a range of seeds"),
        (["--tune", "x.json"], "--tune x.json: thresholds are chosen on tuning seeds only"),
        (["--wire", "--tuning", "--seeds", "0:9", "--tune", "x.json"], "--wire cannot be combined"),
        (
            ["--wire", "--kinds", "tap,fall"],
            "'fall' is not a kind of trial; choose among slide,ramp",
        ),
        (["--wire", "--elements", "8"], "--wire cannot be combined with --elements"),
        (["--kinds", "slide,fall"], "'fall' is not a kind of trial; choose among slide,roll"),
        (["--detector", "ouija"], "--detector ouija: must be one of impulse, paper-hp,"),
        (["--speed", "0"], "--speed 0: must be a speed above 0 mm/s"),
        (["--speed", "3N"], "--speed 3N: 'N' does not convert to mm/s"),
        (["--youngs-modulus", "-1MPa"], "--youngs-modulus -1MPa: must be above 0 MPa"),
        (["--youngs-modulus", "nan"], "--youngs-modulus nan: must be a finite number"),
        (["--speed", "nan"], "--speed nan: must be a finite number"),
        (["--ridge", "12"], "--ridge 12: the skin has only 9 ridges"),
        (["--files", "nowhere.csv"], "nowhere.csv: No such file"),
        (
            ["--files", "list.csv", "--tune", "x.json"],
            "--files cannot be combined with --tune, --tuning or --wire",
        ),
        (["--files", "list.csv", "--seeds", "1000000:1000010"], "combined with --seeds, which is"),
        (["--files", "list.csv", "--kinds", "tap"], "combined with --kinds, which is of random"),
        (["--files", "list.csv", "--swapped-gains"], "combined with --swapped-gains, which is"),
        (["--files", "list.csv", "--jobs", "2"], "combined with --jobs 2: files are scored one"),
    ],
)
def test_what_cannot_be_scored_is_refused_in_one_line(arguments, words, tmp_path):
    assert words in refused(*arguments, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_detector_is_not_scored_on_trials_that_it_has_seen(tmp_path):
    seen = {"statistic": "wavelet", "threshold": 5.0, "floor_mV": 0.3,
            "tuned_on": {"first": 1000005, "end": 1000006}}  # fmt: skip
    file = tmp_path / "seen.json"
    file.write_text(json.dumps({"baselines": [seen]}))
    given = ("--seeds", "1000000:1000010", "--out", tmp_path / "out")
    line = refused(*given, "--baseline-settings", file)
    assert "wavelet was tuned on seeds 1000005:1000006 and is to be scored on" in line


def test_rig_is_not_scored_on_the_reporting_seeds_of_its_threshold_after_turns(tmp_path):
    given = ("--seeds", "1013522:1013530", "--detector", "rig", "--out", tmp_path / "out")
    line = refused(*given, "--wire")
    assert "rig was tuned on seeds 1013303:1013523 and is to be scored on" in line


@pytest.mark.parametrize("more", [(), ("--wire",)])
def test_rig_grip_is_not_scored_on_the_reporting_seeds_of_its_threshold(more, tmp_path):
    """They were scored without a mark (decision 0147)."""
    for seeds in ("1006000:1006447", "1006560:1006561"):
        given = ("--seeds", seeds, "--detector", "rig-grip", "--out", tmp_path / "out", *more)
        line = refused(*given)
        assert "rig-grip was tuned on seeds 1006446:1006561 and is to be scored on" in line
        assert line.endswith("choose seeds that it has not seen"), "these need no --tuning"


def test_parameters_that_differ_are_those_of_one_detector_and_named_in_the_table(tmp_path):
    slip_file(tmp_path)
    (tmp_path / "list.csv").write_text("file\nslip.h5\n")
    deaf = tmp_path / "deaf.toml"
    deaf.write_text("fire_mV = 100.0\n")
    given = ("--files", tmp_path / "list.csv", "--no-roc", "--settings", deaf)
    reported = json.loads(
        run(*given, "--detector", "paper-hp", "--json", "--out", tmp_path / "out")
    )
    assert [one["name"] for one in reported["detectors"]] == ["paper-hp with deaf"]
    assert values(reported)["found"] == 0.0
    line = refused(*given, "--detector", "paper-hp", "--detector", "rig", "--out", tmp_path / "no")
    assert "unclear which of the 2 detectors it changes" in line


def test_an_earlier_score_is_never_overwritten(tmp_path):
    (tmp_path / "score.json").write_text("{}")
    assert "contains a score already" in refused("--out", tmp_path)


def test_options_change_the_population_as_a_file_does(population):
    shown = json.loads(
        run("--show-population", "--population", population, "--youngs-modulus", "0.8MPa",
            "--speed", "1:2", "--elements", "4", "--ridge", "1")
    )  # fmt: skip
    assert shown["skin"]["youngs_modulus_MPa"] == 0.8
    assert shown["skin"]["elements_per_ridge"] == 4
    assert shown["skin"]["ridges"] == 3
    assert shown["speed_mm_s"] == {"low": 1.0, "high": 2.0, "logarithmic": True}
    assert shown["ridge"] == 1
    assert shown["roll_s"] == {**SHORT["roll_s"], "logarithmic": False}
    assert "give one of them" in refused("--show-population", "--show-front-end")
    default = run("--show-population")
    assert PopulationSettings.model_validate_json(default) == PopulationSettings()


@pytest.mark.thorough
def test_trials_are_scored_the_same_by_one_process_and_by_two(tmp_path, population):
    given = ("--seeds", "1000000:1000003", "--population", population, "--baselines",
             "--detector", "paper-hp")  # fmt: skip
    said = run(*given, "--out", tmp_path / "one")
    assert "All trials: simulated trials, reporting seeds 1000000:1000003, 12 trials" in said
    assert "delay after first node slip, 5th percentile (ms)" in said
    assert "armed without a slip: motions under load that no slip followed" in said
    assert said.rstrip().endswith("score.json, score.csv, trials.csv, 3 figures (PNG and SVG)")
    run(*given, "--out", tmp_path / "two", "--jobs", "2")
    for name in ("score.json", "score.csv", "trials.csv"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    rows = table(tmp_path / "one" / "score.csv")
    assert {row["use"] for row in rows} == {"reporting seeds 1000000:1000003"}
    detectors = ["paper-hp", "band power", "wavelet", "cusum", "single channel"]
    reported = list(dict.fromkeys(row["detector"] for row in rows))
    assert reported[:5] == detectors
    assert (reported[5], reported[-2:], len(reported)) == ("blind 50 ms", ["always", "possible"], 9)
    trials = table(tmp_path / "one" / "trials.csv")
    assert len(trials) == 12 * 9
    slips = [row for row in trials if row["label"] in ("slip", "slip in a slide")]
    found = [row["found"] for row in slips if row["detector"] == "cusum"]
    (reported,) = [
        r for r in rows if (r["detector"], r["trait"], r["quantity"]) == ("cusum", "", "found")
    ]
    assert float(reported["value"]) == pytest.approx(found.count("1") / len(found))
    assert int(reported["of"]) == len(found) >= 3
    for stem in ("score-roc", "score-found", "score-delays"):
        assert (tmp_path / "one" / f"{stem}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.thorough
def test_tuned_thresholds_are_written_with_their_seeds_and_every_table_says_tuning(
    tmp_path, population
):
    tuned = tmp_path / "tuned.json"
    reported = json.loads(
        run("--tuning", "--seeds", "0:3", "--population", population, "--tune", tuned, "--no-roc",
            "--detector", "paper-literal", "--kinds", "slide,roll", "--json",
            "--out", tmp_path / "out")
    )  # fmt: skip
    assert reported["simulated"] is True
    assert reported["use"] == "TUNING seeds 0:3"
    assert {row["use"] for row in reported["results"]} == {"TUNING seeds 0:3"}
    rolls = [r for r in reported["results"] if r["quantity"] == "roll_alarms" and not r["trait"]]
    others = {one["name"] for one in reported["trivial_answers"]} | {"paper-literal"}
    assert [r["value"] for r in rolls if r["detector"] not in others] == [0.0] * 4
    written = json.loads(tuned.read_text())["baselines"]
    assert [one["tuned_on"] for one in written] == [{"first": 0, "end": 3}] * 4


def scored(folder: Path, listing: str, out: str) -> dict:
    """What is found in listed files by the default detector."""
    (folder / "list.csv").write_text(listing)
    return json.loads(
        run("--files", folder / "list.csv", "--no-roc", "--json", "--out", folder / out)
    )


def values(reported: dict) -> dict[str, float]:
    """The values of the one detector that was scored."""
    (detector,) = reported["detectors"]
    rows = [row for row in reported["results"] if row["detector"] == detector["name"]]
    return {row["quantity"]: row["value"] for row in rows if not row["trait"]}


@pytest.mark.thorough
def test_labelled_files_are_scored_by_their_list_or_by_what_a_simulated_bench_knows(tmp_path):
    slip_file(tmp_path)
    reported = scored(tmp_path, "file\nslip.h5\n", "own")
    assert [one["name"] for one in reported["detectors"]] == ["paper-hp"], "the default"
    assert reported["simulated"] is True
    found = values(reported)
    assert found["found"] == 1.0
    assert 0 < found["after_ridge_50"] < 12
    assert found["after_node_50"] == pytest.approx(found["after_ridge_50"] + 100, rel=1e-4)
    listed = (
        "file,point,label,motion_s,node_slip_s,ridge_slip_s,noise_mV\n"
        "slip.h5,trial-001,slip,1.1,1.7,1.8,0.1\n"
        "tap.h5,,tap,1.1,,,0.1\n"
    )
    shutil.copy(tmp_path / "slip.h5", tmp_path / "tap.h5")
    reported = scored(tmp_path, listed, "listed")
    found = values(reported)
    assert (found["found"], found["early"], found["tap_alarms"]) == (0.0, 1.0, 1.0)
    assert ("noise_mV", "below 0.2") in {(row["trait"], row["bin"]) for row in reported["results"]}


@pytest.mark.parametrize(
    ("listing", "words"),
    [
        ("name\nslip.h5\n", "has no column 'file'"),
        ("file\n", "lists no file"),
        ("file,label\nslip.h5\n", "line 2: the number of cells differs from the header"),
        ("file,label\nslip.h5,fall\n", "line 2: label 'fall' is not one of slip, slip in a slide"),
        ("file,point\nslip.h5,trial-9\n", "slip.h5 has no point 'trial-9'"),
        ("file,motion_s\nslip.h5,\n", "line 2: motion_s is missing"),
        ("file,motion_s\nslip.h5,soon\n", "line 2: motion_s 'soon' is not a number"),
        ("file,label,ridge_slip_s\nslip.h5,slip,\n", "a trial labelled 'slip' needs ridge_slip_s"),
        (
            "file,label,motion_s,ridge_slip_s\nslip.h5,tap,1.1,1.5\n",
            "line 2: label 'tap' with ridge_slip_s 1.5 s, the time at which the whole ridge",
        ),
        ("file,noise_mV\nslip.h5,much\n", "line 2: noise_mV 'much' is not a number"),
        ("file,remark\nslip.h5,good\n", "remark 'good' is not a number; leave the column out"),
        ("file,lable\nslip.h5,slip\n", "the column 'lable' is not known: did you mean 'label'?"),
        ("file,lift_of_s\nslip.h5,1.9\n", "'lift_of_s' is not known: did you mean 'lift_off_s'?"),
        ("file,Motion\nslip.h5,1.1\n", "'Motion' is not known: did you mean 'motion_s'?"),
        ("file,motion_s\nslip.h5,900\n", "line 2: motion_s 900 s: the record is from 0 to "),
        (
            "file,motion_s,ridge_slip_s\n\nslip.h5,0.5,0.2\n",
            "line 3: ridge_slip_s 0.2 s is before motion_s 0.5 s",
        ),
        ("file\nslip.h5\nslip.h5\n", "line 3: the trial of line 2, which would be judged twice"),
        (
            "file,label,motion_s,ridge_slip_s\nslip.h5,slip,0.5,1.5\n./slip.h5,hold,0.5,\n",
            "line 3: the trial of line 2, which would be judged twice",
        ),
        ("file\nslip.h5\ngone.h5\n", "line 3: "),
    ],
)
def test_a_list_that_cannot_be_used_is_refused_with_its_line(listing, words, tmp_path):
    slip_file(tmp_path)
    (tmp_path / "list.csv").write_text(listing)
    line = refused("--files", tmp_path / "list.csv", "--detector", "paper-hp", "--out",
                   tmp_path / "out")  # fmt: skip
    assert words in line


def test_a_line_that_cannot_be_used_is_named_before_the_first_trial_is_judged(tmp_path):
    slip_file(tmp_path)
    shutil.copy(tmp_path / "slip.h5", tmp_path / "other.h5")
    (tmp_path / "list.csv").write_text("file,motion_s\nslip.h5,1.1\nother.h5,900\n")
    given = ("--files", tmp_path / "list.csv", "--out", tmp_path / "out")
    result = CliRunner().invoke(app, [str(each) for each in given])
    (line,) = result.stderr.splitlines()
    assert "line 3: motion_s 900 s: the record is from 0 to 3 s" in line


def test_two_scores_into_one_folder_do_not_mix(tmp_path):
    """The later one replaced the tables of the other, in which there were hours of work."""
    slip_file(tmp_path)
    (tmp_path / "list.csv").write_text("file\nslip.h5\n")
    out = tmp_path / "out"
    given = ("--files", tmp_path / "list.csv", "--out", out, "--no-roc")
    with reserved(out):
        assert f"--out {out}: another rig score is running that will write there" in refused(*given)
    assert not out.exists(), "it was not used"
    run(*given)
    before = (out / "score.json").read_bytes()
    assert "contains a score already" in refused(*given)
    with pytest.raises(ConfigurationError, match="contains a score already"), reserved(out):
        pass  # as one that was not there when the command began
    assert (out / "score.json").read_bytes() == before


def test_a_folder_that_cannot_be_written_to_is_named_before_the_first_trial_is_judged(tmp_path):
    slip_file(tmp_path)
    (tmp_path / "list.csv").write_text("file\nslip.h5\n")
    given = ("--files", tmp_path / "list.csv", "--out", "/proc/out")
    result = CliRunner().invoke(app, [str(each) for each in given])
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert "/proc/out cannot be written: " in line


def test_the_file_of_thresholds_is_checked_before_they_are_chosen(tmp_path):
    given = ("--tuning", "--seeds", "0:900000", "--out", tmp_path / "out")
    (tmp_path / "mine.json").write_text("mine")
    assert "mine.json: exists already" in refused(*given, "--tune", tmp_path / "mine.json")
    assert "no such folder" in refused(*given, "--tune", tmp_path / "none" / "x.json")
    assert not (tmp_path / "out").exists()


def test_a_rate_that_is_not_judged_is_named_before_the_first_trial_is_judged(tmp_path):
    """It was named after all trials above it had been judged, and these scores were lost."""
    slip_file(tmp_path)
    slip_file(tmp_path, "slow", rate_Hz=100.0)
    (tmp_path / "list.csv").write_text("file,motion_s\nslip.h5,1.1\nslow.h5,11\n")
    line = refused("--files", tmp_path / "list.csv", "--out", tmp_path / "out")
    assert "list.csv, line 3: slow.h5 trial-001: rate 100 Hz must be between 500 and" in line


def test_a_slip_without_its_time_is_named_before_the_first_trial_is_judged(tmp_path):
    slip_file(tmp_path)
    slip_file(tmp_path, "other", simulated=False)
    (tmp_path / "list.csv").write_text(
        "file,label,motion_s,ridge_slip_s\nslip.h5,slip,1.1,1.5\nother.h5,slip,1.1,\n"
    )
    line = refused("--files", tmp_path / "list.csv", "--out", tmp_path / "out")
    assert "line 3: other.h5 trial-001: a trial labelled 'slip' needs ridge_slip_s" in line


def test_a_table_of_the_simulated_bench_says_what_it_leaves_out_and_its_judging_how_far_it_is(
    tmp_path, monkeypatch
):
    """Twenty seeds with three detectors are judged for minutes after the last trial was made."""
    time = np.arange(2000) / 1000
    press = np.where((time > 0.3) & (time < 0.6), -4.5e-3 * np.sin(np.pi * (time - 0.3) / 0.3), 0.0)
    record = WireRecord(
        np.column_stack([press, press]), 1000.0, Truth("slip", 1.0, 1.4, 1.5, 1.6, record_s=2.0),
        0.2, 1.0, {},
    )  # fmt: skip

    def made(kinds, seeds, cache, jobs, done):
        for number, seed in enumerate(seeds, 1):
            done(number, len(seeds), number)
            trial = drawn("slide", seed, None)
            yield MadeTrial(trial, record) if seed % 3 else MadeTrial(trial, None, "too steep")

    monkeypatch.setattr(judging, "make_trials", made)
    given = ("--wire", "--seeds", "1000000:1000004", "--kinds", "slide", "--detector", "paper-hp",
             "--no-roc", "--out", str(tmp_path / "out"))  # fmt: skip
    result = CliRunner().invoke(app, given, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    heading = result.stdout.splitlines()[0]
    assert heading.endswith("1000000:1000004, 3 trials (1 trial could not be made)")
    assert "1000002 could not be made: too steep" in result.stderr
    assert "score: 3 of 3 trials scored" in result.stderr


def test_no_score_is_saved_of_trials_none_of_which_could_be_made(tmp_path, monkeypatch):
    def made(kinds, seeds, cache, jobs, done):
        for seed in seeds:
            yield MadeTrial(drawn("slide", seed, None), None, "too steep")

    monkeypatch.setattr(judging, "make_trials", made)
    given = ("--wire", "--seeds", "1000000:1000002", "--kinds", "slide",
             "--out", str(tmp_path / "out"))  # fmt: skip
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 5, result.output
    assert result.stdout == ""
    assert "none of the 2 trials could be made, so nothing is scored" in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.nightly
def test_trials_are_made_on_the_whole_simulated_bench_once(tmp_path):
    given = ("--wire", "--seeds", "1000000:1000001", "--kinds", "hold", "--detector", "paper-hp",
             "--no-roc")  # fmt: skip
    reported = json.loads(run(*given, "--json", "--out", tmp_path / "one"))
    assert reported["failed"] == {}
    assert reported["use"] == "on the simulated bench, reporting seeds 1000000:1000001"
    (trial,) = [
        row for row in table(tmp_path / "one" / "trials.csv") if row["detector"] == "paper-hp"
    ]
    assert (trial["trial"], trial["kind"]) == ("hold 1000000", "hold")
    assert trial["label"] in ("slip", "slip in a slide", "partial slip")
    assert float(trial["quiet_s"]) > 0.2
    assert 50 <= float(trial["tick_Hz"]) <= 500
    result = CliRunner().invoke(app, [*map(str, given), "--out", str(tmp_path / "two")])
    assert "score: 1 of 1 trials, 0 of them made now" in result.stderr
    same = [(tmp_path / out / "trials.csv").read_bytes() for out in ("one", "two")]
    assert same[0] == same[1]
