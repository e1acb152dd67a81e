"""``rig train``: refusals before anything is computed, and learning from run files."""

import errno
import json
import sys
from pathlib import Path

import pytest
import typer
from strips_file import slip_file
from typer.testing import CliRunner

from rig.cli.commands.train import train
from rig.cli.options.detector import detector_with_settings
from rig.core.errors import ConfigurationError
from rig.detector.kernel import INPUTS
from rig.detector.network import Network
from rig.evaluation.labelled_files import listed_trials
from rig.evaluation.lessons import LESSON_POPULATION

train_module = sys.modules[train.__module__]
app = typer.Typer(pretty_exceptions_enable=False)
app.command()(train)


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(each) for each in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def refused(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    assert result.exit_code == 2, result.output
    return result.stderr.splitlines()[-1]


@pytest.fixture
def listing(tmp_path: Path) -> Path:
    """Five trials of two samples on two days each; the rolls have no label."""
    lines = ["file,label,ridge_slip_s,node_slip_s"]
    for number, (sample, day) in enumerate(
        [("a", "2026-11-01"), ("a", "2026-11-02"), ("a", "2026-11-02"), ("b", "2026-11-03"),
         ("b", "2026-11-04")]
    ):  # fmt: skip
        rolls = number in (1, 4)
        slip_file(
            tmp_path, f"t{number}", sample=sample, day=day, simulated=False,
            procedure="roll-trial" if rolls else "slip-trial",
        )  # fmt: skip
        lines.append(f"t{number}.h5," + (",," if rolls else "slip,1.5,1.4"))
    (tmp_path / "list.csv").write_text("\n".join(lines) + "\n")
    return tmp_path / "list.csv"


def test_a_network_is_trained_on_run_files_alone_and_says_so(tmp_path: Path, listing: Path):
    out = tmp_path / "net.json"
    said = run("--out", out, "--files", listing, "--epochs", "3", "--units", "4")
    network = Network.model_validate_json(out.read_bytes())
    assert network.inputs == INPUTS
    assert len(network.hidden) == 2 * 4
    assert network.trained_on == "3 trials of run files", "two were held out"
    assert network.name == "net"  # `rig show` names it beside the one of the program
    assert f"--files {listing} --members 2 --units 4 --epochs 3" in network.trained_by
    assert (network.first_seed, network.last_seed) == (0, -1)
    # Sample b was held out: a slip and a roll.
    assert "slip, in time: " in said
    assert "/1 (" in said
    assert "roll, false alarm: " in said
    said = run("--out", tmp_path / "all.json", "--files", listing, "--epochs", "1", "--all")
    assert "held out" not in said
    of_all = Network.model_validate_json((tmp_path / "all.json").read_bytes())
    assert "--all" in of_all.trained_by
    assert of_all.trained_on == "5 trials of run files"
    assert run("--out", tmp_path / "b.json", "--files", listing, "--epochs", "3", "--units", "4")
    again = json.loads((tmp_path / "b.json").read_text())
    assert again | {"name": "net"} == json.loads(out.read_text())
    (tmp_path / "own.toml").write_text('network = "net.json"\n')
    chosen = detector_with_settings("rig", tmp_path / "own.toml")
    assert chosen.settings.network == network
    (tmp_path / "own.toml").write_text('network = "list.csv"\n')
    with pytest.raises(ConfigurationError, match=r"list\.csv: no network"):
        detector_with_settings("rig", tmp_path / "own.toml")


def test_a_roll_trial_without_a_label_has_no_slip_and_its_motion_begins_where_its_file_says(
    listing: Path,
):
    trials = [one for one, _ in listed_trials(listing)]
    assert [one.truth.label for one in trials] == ["slip", "roll", "slip", "slip", "roll"]
    assert [one.rolls for one in trials] == [False, True, False, False, True]
    assert all(one.truth.motion_s == 1.0 for one in trials)
    assert [len(one.slips_s) for one in trials] == [1, 0, 1, 1, 0]
    assert not any(one.ends_known for one in trials)  # the list says when they slip only


def test_trials_that_share_samples_or_days_are_never_on_both_sides(tmp_path: Path):
    for number, (sample, day) in enumerate([("a", "2026-11-01"), ("b", "2026-11-01")]):
        slip_file(tmp_path, f"t{number}", sample=sample, day=day)
    (tmp_path / "list.csv").write_text("file\nt0.h5\nt1.h5\n")
    line = refused("--out", tmp_path / "net.json", "--files", tmp_path / "list.csv")
    assert "all 2 trials share samples or days (a, b), so that none can be held out" in line
    everything = ("--all", "--epochs", "1", "--units", "2", "--members", "1")
    said = run("--out", tmp_path / "net.json", "--files", tmp_path / "list.csv", *everything)
    assert "trained on 2 trials of run files" in said
    assert "held out" not in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--seeds", "1000000:1000010"), "are reserved for reporting; no detector is trained"),
        (("--wire", "999999:1000001"), "--wire 999999:1000001: seeds from 1000000 on are reserved"),
        (("--wire", "many"), "--wire many: not a range of seeds"),
        (("--seeds", "0:0"), "for example 0:100"),
        (("--files", "missing.csv"), "missing.csv"),
        (("--wire", "0:5", "--population", "p.json"), "--population changes trials of the skin"),
        (("--wire", "0:5", "--front-end", "f.json"), "--front-end changes trials of the skin"),
        (("--population", "missing.json"), "missing.json"),
    ],
)
def test_what_cannot_be_learnt_from_is_refused_in_one_line(tmp_path: Path, arguments, words):
    assert words in refused("--out", tmp_path / "net.json", *arguments)
    assert not (tmp_path / "net.json").exists()


@pytest.mark.parametrize(
    ("option", "settings", "words"),
    [
        ("--population", {"ridge": 12}, "ranges.json: ridge 12: the skin has only 9 ridges"),
        (
            "--population",
            {"speed_mm_s": {"low": 0, "high": 1}},
            "ranges.json: speed_mm_s: low 0: must be above 0",
        ),
        (
            "--population",
            {"tap_s": {"low": 0, "high": 1, "logarithmic": True}},
            "ranges.json: tap_s: low 0 of a logarithmic range: must be above 0; or set",
        ),
        (
            "--front-end",
            {"noise_mV": {"low": 5, "high": 1}},
            "ranges.json: noise_mV: low 5 is above high 1: exchange them",
        ),
    ],
)
def test_a_range_from_which_nothing_can_be_drawn_is_named(tmp_path: Path, option, settings, words):
    """It was "math domain error" or "high - low < 0", in the first trial."""
    file = tmp_path / "ranges.json"
    file.write_text(json.dumps(settings))
    assert words in refused("--out", tmp_path / "net.json", "--seeds", "0:5", option, file)


def test_files_in_which_nothing_is_touched_are_refused(tmp_path: Path):
    for number, sample in enumerate("ab"):
        slip_file(tmp_path, f"t{number}", sample=sample, day=f"2026-11-0{number + 1}", gain=1e-4)
    (tmp_path / "list.csv").write_text("file\nt0.h5\nt1.h5\n")
    said = refused("--out", tmp_path / "net.json", "--files", tmp_path / "list.csv")
    assert "2 trials of run files: in none of them is the skin touched" in said
    assert not (tmp_path / "net.json").exists()


def test_what_never_slips_teaches_nothing_and_is_refused(tmp_path: Path):
    slip_file(tmp_path, "t0", procedure="roll-trial", simulated=False)
    (tmp_path / "list.csv").write_text("file\nt0.h5\n")
    said = refused("--out", tmp_path / "net.json", "--files", tmp_path / "list.csv", "--all")
    assert "1 trial of run files: those to learn from have no slip of the whole ridge" in said
    assert not (tmp_path / "net.json").exists()


def test_a_folder_that_cannot_be_written_to_is_refused_before_the_training(tmp_path: Path):
    said = refused("--out", "/proc/net.json", "--files", tmp_path / "missing.csv")
    assert "--out /proc/net.json: its folder cannot be written to: " in said


def test_a_network_that_the_disk_does_not_take_is_named(tmp_path: Path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(train_module, "write_text", full)
    slip_file(tmp_path, "t0")
    (tmp_path / "list.csv").write_text("file\nt0.h5\n")
    given = ("--out", tmp_path / "net.json", "--files", tmp_path / "list.csv", "--all")
    small = ("--epochs", "1", "--units", "2", "--members", "1")
    result = CliRunner().invoke(app, [str(each) for each in (*given, *small)])
    assert result.exit_code == 1
    said = result.stderr.splitlines()[-1]
    assert "net.json: the network cannot be written: No space left on device; free space" in said


SMALL = ("--all", "--epochs", "1", "--units", "2", "--members", "1")


@pytest.mark.parametrize(
    ("listing", "words"),
    [
        (
            "file,motion_s\nt0.h5,1.1\nslow.h5,11\n",
            "list.csv, line 3: slow.h5 trial-001: rate 100 Hz must be between 500 and 50000 Hz",
        ),
        (
            "file,label,motion_s,ridge_slip_s\nt0.h5,slip,1.1,1.5\nslow.h5,slip,11,\n",
            "line 3: slow.h5 trial-001: a trial labelled 'slip' needs ridge_slip_s",
        ),
        (
            "file,label,motion_s,ridge_slip_s\nt0.h5,slip,1.1,1.5\nslow.h5,hold,11,15\n",
            "line 3: label 'hold' with ridge_slip_s 15 s",
        ),
    ],
)
def test_a_file_that_would_teach_something_wrong_is_refused_before_other_trials_are_made(
    tmp_path: Path, listing: str, words: str
):
    """A recording at 100 Hz was learnt from, and a slip without its time taught as none."""
    slip_file(tmp_path, "t0")
    slip_file(tmp_path, "slow", rate_Hz=100.0)
    (tmp_path / "list.csv").write_text(listing)
    given = ("--out", tmp_path / "net.json", "--files", tmp_path / "list.csv", *SMALL)
    result = CliRunner().invoke(app, [str(each) for each in (*given, "--seeds", "0:900000")])
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert words in line


def test_all_is_not_the_remedy_where_it_is_given(tmp_path: Path):
    slip_file(tmp_path, "t0", procedure="roll-trial", simulated=False)
    (tmp_path / "list.csv").write_text("file\nt0.h5\n")
    given = ("--out", tmp_path / "net.json", "--files", tmp_path / "list.csv")
    assert refused(*given, *SMALL).endswith("add trials with slips (label, ridge_slip_s)")


def test_two_trainings_into_one_file_both_leave_their_networks(tmp_path: Path, monkeypatch):
    """The second one to end replaced the network of the first."""
    slip_file(tmp_path, "t0")
    (tmp_path / "list.csv").write_text("file\nt0.h5\n")
    trained = train_module._trained

    def meanwhile(*arguments: object) -> object:
        found = trained(*arguments)
        (tmp_path / "net.json").write_text("the other's")
        return found

    monkeypatch.setattr(train_module, "_trained", meanwhile)
    given = ("--out", tmp_path / "net.json", "--files", tmp_path / "list.csv", *SMALL)
    said = run(*given)
    assert (tmp_path / "net.json").read_text() == "the other's"
    assert f"saved {tmp_path / 'net-2.json'}: " in said
    second = Network.model_validate_json((tmp_path / "net-2.json").read_bytes())
    assert second.name == "net-2", "as the file"


def test_an_interrupted_training_says_what_the_same_command_repeats(tmp_path: Path, monkeypatch):
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(train_module, "_trained", stopped)
    slip_file(tmp_path, "t0")
    (tmp_path / "list.csv").write_text("file\nt0.h5\n")
    given = ("--out", tmp_path / "net.json", "--files", tmp_path / "list.csv", *SMALL)
    result = CliRunner().invoke(app, [str(each) for each in given])
    assert "train: interrupted, and no network is saved; trials" in result.stderr


def test_a_network_is_saved_before_it_is_judged(tmp_path: Path, listing: Path, monkeypatch):
    """What holds out many trials is judged for minutes, in which it may be interrupted."""

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(train_module, "_judge", stopped)
    given = ("--out", tmp_path / "net.json", "--files", listing, "--epochs", "1", "--units", "2")
    result = CliRunner().invoke(app, [str(each) for each in given])
    assert f"saved {tmp_path / 'net.json'}: network of 4 units" in result.stdout


def test_one_trial_cannot_be_held_out(tmp_path: Path):
    slip_file(tmp_path, "t0")
    (tmp_path / "list.csv").write_text("file\nt0.h5\n")
    said = refused("--out", tmp_path / "net.json", "--files", tmp_path / "list.csv")
    assert "--files: it lists one trial, so that none can be held out" in said


def test_an_earlier_network_is_never_overwritten(tmp_path: Path):
    (tmp_path / "net.json").write_text("mine")
    assert "exists already" in refused("--out", tmp_path / "net.json")


@pytest.mark.thorough
def test_a_network_is_trained_on_the_model_with_ranges_of_a_file(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("RIG_CACHE", str(tmp_path / "cache"))
    short = LESSON_POPULATION.model_dump() | {
        "ridge": 2,
        "drawn_skin": False,
        "skin": {"ridges": 3, "elements_per_ridge": 3},
        "normal_force_N": {"low": 1.0, "high": 1.5},
        "speed_mm_s": {"low": 4.0, "high": 6.0},
        "start_x_mm": {"low": -0.3, "high": 0.3},
        "radius_mm": {"low": 5.0, "high": 10.0},
    }
    (tmp_path / "short.json").write_text(json.dumps(short))
    said = run("--out", tmp_path / "net.json", "--seeds", "0:5", "--population",
               tmp_path / "short.json", "--epochs", "2", "--units", "2")  # fmt: skip
    network = Network.model_validate_json((tmp_path / "net.json").read_bytes())
    assert network.trained_on == "40 trials of the skin model", "one in five is held out"
    assert (network.first_seed, network.last_seed) == (0, 4)
    assert "held out" in said
