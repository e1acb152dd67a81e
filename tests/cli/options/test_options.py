"""Settings on the command line: quantities with units, lists, and errors that name the option."""

from __future__ import annotations

import math
import re
from typing import Any, Literal

import numpy as np
import pytest
from pydantic import Field, ValidationError, model_validator

from procedures.roll_trial.settings import RollTrialSettings
from procedures.sweep.settings import LISTEN_S, SweepSettings
from rig.analysis.response.sine_fit import fit_sine, mains_lines
from rig.cli.options.settings import option_name, parameters, settings_from, texts_of
from rig.core.errors import ConfigurationError, ExitCode, RigError
from rig.core.settings import Settings
from rig.core.units import parse, quantity
from rig.run.load_procedure import load_procedure


class Example(Settings):
    """Settings of a made-up procedure."""

    normal_force_N: float = Field(default=2.0, gt=0, le=20)
    """Preload."""
    settling_s: float = 0.2
    """Wait."""
    speeds_mm_s: tuple[float, ...] = Field(default=(1.0, 5.0), min_length=1)
    """Speeds."""
    rate_S_s: float | None = None
    """Rate, if not the usual one."""
    cycles: int = Field(default=4, ge=1)
    """Cycles."""
    label: str = ""
    """Label."""
    ratio: float = 1.0
    """A number without a unit."""
    speed_mm_s: float = Field(default=1.0, json_schema_extra={"not_with": "speeds_mm_s"})
    """Speed."""
    loading: Literal["slide", "ramp"] = "slide"
    """Loading."""
    ramp_N_s: float = Field(default=2.0, json_schema_extra={"only_with": {"loading": "ramp"}})
    """Rate."""


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("4", "N", 4.0),
        ("4N", "N", 4.0),
        (" 4 N ", "N", 4.0),
        ("-0.5", "N", -0.5),
        (".5e1", "N", 5.0),
        ("4000mN", "N", 4.0),
        ("0.2 kN", "N", 200.0),
        ("200ms", "s", 0.2),
        ("2min", "s", 120.0),
        ("3e-3m", "mm", 3.0),
        ("2 cm/s", "mm/s", 20.0),
        ("2kHz", "Hz", 2000.0),
        ("50kHz", "1/s", 50_000.0),
        ("180 deg", "rad", math.pi),
        ("5%", "percent", 5.0),
        ("3", None, 3.0),
    ],
)
def test_a_quantity_may_carry_any_unit_that_converts(
    text: str, unit: str | None, value: float
) -> None:
    assert quantity(text, unit) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "unit", "reported"),
    [
        ("3V", "N", "'V' does not convert to N"),
        ("3 furlongs/blink", "mm/s", "does not convert to mm/s"),
        ("3 N N", "N", "does not convert to N"),
        ("3 ;", "N", "';' is not a unit"),
        ("3 1/0", "N", "'1/0' is not a unit"),
        ("3 N/0", "N", "is not a unit; write it as N"),
        ("3 ((", "N", "is not a unit"),
        ("four", "N", "is not a number in N"),
        ("", None, "is not a number$"),
        ("3N", None, "takes a bare number, not 'N'"),
        ("1.2.3", "N", "is not a unit"),
        ("0,5 mm/s", "mm/s", "a comma is not a decimal point: write 0.5$"),
        ("0,5", None, "a comma is not a decimal point: write 0.5$"),
        ("1,000 N", "N", "not a decimal point: write the number without a comma$"),
        ("12,000,000", "N", "not a decimal point: write the number without a comma$"),
        ("1,5e3 N", "N", "a comma is not a decimal point: write 1.5e3$"),
        ("1.25,3,6", "N", "takes one number, not a list$"),
        ("1,5,10", "N", "takes one number, not a list$"),
        ("0.5,1 N", "N", "takes one number, not a list$"),
    ],
)
def test_anything_else_is_refused_with_the_reason(
    text: str, unit: str | None, reported: str
) -> None:
    with pytest.raises(ValueError, match=reported):
        quantity(text, unit)


def test_lists_are_separated_by_commas_and_each_item_may_have_its_unit() -> None:
    floats = tuple[float, ...]
    assert parse("1, 2cm/s ,3 mm/s", floats, "mm/s") == (1.0, 20.0, 3.0)
    assert parse("none", float | None, "1/s") is None
    assert parse("5", float | None, "1/s") == 5.0
    with pytest.raises(ValueError, match=r"^'abc' is not a number in mm/s$"):
        parse("1, abc", floats, "mm/s")
    with pytest.raises(ValueError, match=r"^'3 kg': 'kg' does not convert to mm/s$"):
        parse("1, 3 kg", floats, "mm/s")


@pytest.mark.parametrize("text", ["1,,2", "1,", ",1"])
def test_a_list_with_a_hole_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="a value is missing"):
        parse(text, tuple[float, ...], "mm/s")


@pytest.mark.parametrize("text", ["", " ", ",", " , "])
def test_a_list_without_an_item_is_refused(text: str) -> None:
    """It is not the default: that is meant by leaving the option out."""
    with pytest.raises(ValueError, match="the list is empty"):
        parse(text, tuple[float, ...], "mm/s")


def test_options_carry_no_unit_and_default_to_the_settings() -> None:
    assert option_name("normal_force_N") == "--normal-force"
    assert option_name("speeds_mm_s") == "--speeds"
    assert settings_from(Example, dict.fromkeys(Example.model_fields)) == Example()


def test_given_texts_become_settings() -> None:
    given = {
        "normal_force_N": "4000 mN",
        "settling_s": "200ms",
        "speeds_mm_s": "1,2,1cm/s",
        "rate_S_s": "2kHz",
        "cycles": "7",
        "label": "3 N",
        "ratio": None,
    }
    assert settings_from(Example, given) == Example(
        normal_force_N=4.0,
        settling_s=0.2,
        speeds_mm_s=(1.0, 2.0, 10.0),
        rate_S_s=2000.0,
        cycles=7,
        label="3 N",
    )


def test_what_a_curve_must_be_is_one_sentence() -> None:
    angles = {"profile_times_s": "0,1,2", "profile_angles_deg": "0,1,1"}
    with pytest.raises(ConfigurationError) as caught:
        settings_from(RollTrialSettings, angles)
    assert "--profile-angles must begin and end with 0 deg, upright" in caught.value.one_line()


@pytest.mark.parametrize(
    ("given", "reported"),
    [
        ({"normal_force_N": "4V"}, ["--normal-force 4V: 'V' does not convert to N"]),
        ({"speeds_mm_s": "1,two"}, ["--speeds 1,two"]),
        ({"normal_force_N": "0"}, ["--normal-force 0: must be above 0 N"]),
        ({"normal_force_N": "nan"}, ["--normal-force", "finite"]),
        ({"speeds_mm_s": "nan"}, ["--speeds nan: must be a finite number; see --help"]),
        ({"cycles": "4.5"}, ["--cycles 4.5: must be a whole number"]),
        ({"cycles": "0"}, ["--cycles 0: must be at least 1"]),
        ({"ratio": "3 N"}, ["--ratio 3 N: takes a bare number"]),
        (
            {"normal_force_N": "4V", "settling_s": "long"},
            ["--normal-force 4V", "--settling long"],
        ),
        ({"normal_force_N": "30", "cycles": "0"}, ["--normal-force", "--cycles"]),
    ],
)
def test_all_wrong_options_are_reported_by_their_own_names(
    given: dict[str, str], reported: list[str]
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        settings_from(Example, given)
    line = caught.value.one_line()
    for words in reported:
        assert words in line
    assert "--help" in line
    assert caught.value.code == ExitCode.USAGE


def test_every_field_becomes_one_option_with_unit_and_default_in_its_help() -> None:
    found = {p.name: p.annotation.__metadata__[0] for p in parameters(Example)}
    assert list(found) == list(Example.model_fields)
    assert found["normal_force_N"].metavar == "N"
    assert found["normal_force_N"].help == "Preload.  [default: 2 N; above 0, at most 20]"
    assert found["speeds_mm_s"].help == "Speeds.  [default: 2 values, 1 to 5 mm/s]"
    assert found["cycles"].metavar == "COUNT"
    assert found["rate_S_s"].help == "Rate, if not the usual one."
    assert found["cycles"].help == "Cycles.  [default: 4; at least 1]"
    assert found["speed_mm_s"].help == "Speed. Not with --speeds.  [default: 1 mm/s]"
    assert found["ramp_N_s"].help == "Rate. Only with --loading ramp.  [default: 2 N/s]"


def test_an_option_without_effect_is_refused_with_what_it_needs() -> None:
    with pytest.raises(ConfigurationError) as caught:
        settings_from(Example, {"ramp_N_s": "5"})
    assert caught.value.one_line() == (
        "--ramp 5 has an effect only with --loading ramp, and --loading is slide; leave it out, or "
        "add --loading ramp"
    )
    assert settings_from(Example, {"ramp_N_s": "5", "loading": "ramp"}).loading == "ramp"
    with pytest.raises(ConfigurationError, match="--speed 3 cannot be combined with --speeds"):
        settings_from(Example, {"speed_mm_s": "3", "speeds_mm_s": "1,2"})


@pytest.mark.parametrize(
    ("procedure", "given", "reported"),
    [
        ("sweep", "--gain-bound 0.2", "--gain-bound 0.2 has an effect only with --loads"),
        (
            "slip-trial",
            "--loading ramp --hold-for 2",
            "--hold-for 2 has an effect only with --hold-at",
        ),
        ("slip-trial", "--loading ramp --lost 0.1", "--lost 0.1 has an effect only with --hold-at"),
        (
            "slip-trial",
            "--loading ramp --ramp-to 5 --hold-at 3N",
            "--ramp-to 5 cannot be combined with --hold-at",
        ),
        (
            "roll-trial",
            "--profile-times 0,1,2 --profile-angles 0,1,0 --angle 3",
            "--angle 3 cannot be combined with --profile-times",
        ),
        (
            "roll-trial",
            "--profile-times 0,1,2 --profile-angles 0,1,0 --stay 1s",
            "--stay 1s cannot be combined with --profile-times",
        ),
        (
            "roll-trial",
            "--alignment none --largest-offset 2",
            "--largest-offset 2 has an effect only with --alignment compensate or measure, and "
            "--alignment is none",
        ),
    ],
)
def test_what_has_no_effect_in_the_given_mode_is_refused(rig, procedure, given, reported) -> None:
    ended = rig.run(procedure, "--dry-run", *given.split())
    assert ended.code == ExitCode.USAGE
    assert reported in ended.stderr


@pytest.mark.parametrize(
    ("procedure", "given", "reported"),
    [
        (
            "sweep",
            {"rate_S_s": "80", "frequencies_Hz": "20"},
            "--rate 80 1/s is too slow for --mains 50 Hz: at least 104 1/s is needed",
        ),
        (
            "sweep",
            {"slowest_rate_S_s": "100"},
            "--slowest-rate 100 1/s is too slow for --mains 50 Hz: at least 104 1/s is needed",
        ),
        (
            "sweep",
            {"rate_S_s": "100", "frequencies_Hz": "20,200"},
            "--rate 100 1/s is too slow for 200 Hz: at least 500 1/s is needed",
        ),
        (
            "sweep",
            {"rate_S_s": "100"},
            "--rate 100 1/s is too slow for --highest 20000 Hz: at least 50000 1/s is needed",
        ),
        ("sweep", {"mains_Hz": "1e308"}, "--mains 1e308: must be at most 1000 Hz"),
        (
            "slip-trial",
            {"acceleration_mm_s2": "1e308"},
            "--acceleration 1e308: must be at most 50000 mm/s^2",
        ),
    ],
)
def test_settings_that_cannot_work_are_refused_as_they_were_given(
    procedure: str, given: dict[str, str], reported: str
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        settings_from(load_procedure(procedure).Settings, given)
    assert caught.value.message == reported


@pytest.mark.parametrize("mains_Hz", [2.0, 16.7, 50.0, 60.0, 400.0])
def test_the_slowest_rate_that_a_sweep_takes_lets_it_fit_the_mains(mains_Hz: float) -> None:
    rate_S_s = max(32.0, 2 * mains_Hz + 4)
    settings = SweepSettings(mains_Hz=mains_Hz, rate_S_s=rate_S_s, frequencies_Hz=(5.0,))
    noise = np.random.default_rng(1).normal(size=round(LISTEN_S * settings.listen_rate_S_s))
    first, *others = mains_lines(mains_Hz)
    assert fit_sine(noise, rate_S_s, first, interference=others).n == noise.size
    with pytest.raises(ValidationError, match="too slow for mains_Hz"):
        SweepSettings(mains_Hz=mains_Hz, rate_S_s=rate_S_s - 1, frequencies_Hz=(5.0,))


@pytest.mark.parametrize(
    ("given", "reported"),
    [
        ("sweep --seed 1.5", "'--seed': 1.5: must be a whole number, 0 to 9223372036854775807"),
        ("sweep --seed -1", "'--seed': -1: must be a whole number, 0 to"),
        (f"simulate --seed {2**63}", f"'--seed': {2**63}: must be a whole number, 0 to"),
        ("page --rate 100", "'--rate': 100: must be a number, 1 to 20"),
        ("monitor --seconds nan", "'--seconds': nan: must be a number, at least 0"),
        ("train --epochs 0", "'--epochs': 0: must be a whole number, 1 to 1000"),
    ],
)
def test_a_number_outside_its_bounds_is_refused_in_plain_words(rig, given, reported) -> None:
    ended = rig.run(*given.split())
    assert ended.code == ExitCode.USAGE
    assert reported in " ".join(ended.stderr.split())


@pytest.mark.parametrize(
    "given",
    [
        *(f"slip-trial {option}" for option in ("--user", "--sample", "--notes", "--accept")),
        *(f"import x.csv --channels v_1=1 {option}" for option in ("--user", "--sensor")),
    ],
)
def test_a_text_that_is_not_utf8_is_refused_before_a_bench_is_started(rig, given: str) -> None:
    ended = rig.run(*given.split(), "M\udcfcller")
    assert (ended.code, ended.stderr.splitlines()) == (ExitCode.USAGE, ended.errors)
    (error,) = ended.errors
    assert rf"{given.split()[-1]} M\udcfcller: this text is not UTF-8, so a run file" in error
    assert error.endswith("; set the terminal to UTF-8, or use ASCII characters only")


@pytest.mark.parametrize("reason", ["", " "])
def test_an_acceptance_without_a_reason_is_refused_before_a_bench_is_started(
    rig, reason: str
) -> None:
    """Without this it was taken for none, and the run was compared with the earlier ones."""
    ended = rig.run("path-trial", "--accept", reason)
    assert (ended.code, ended.stderr.splitlines()) == (ExitCode.USAGE, ended.errors)
    (error,) = ended.errors
    assert f"--accept {reason!r}: must be a reason" in error


def test_bounds_in_the_help_are_words(rig) -> None:
    shown = rig.run("train", "--help").stdout
    assert "x<=" not in shown
    assert "x>=" not in shown
    assert "1 to 1000" in shown


def test_a_validator_that_fails_is_a_fault_of_its_package_in_one_line() -> None:
    class Ratio(Settings):
        way_mm: float = 1.0
        part_mm: float = 1.0

        @model_validator(mode="after")
        def _fits(self) -> Any:
            if self.way_mm / self.part_mm < 1:
                raise ValueError("too short")
            return self

    with pytest.raises(RigError) as failed:
        settings_from(Ratio, {"way_mm": None, "part_mm": "0"})
    line = failed.value.one_line()
    assert re.search(r"Ratio cannot check these settings: .*test_options.py line \d+: Zero", line)
    assert failed.value.code is ExitCode.INTERNAL


def test_a_list_may_be_given_in_parts_and_of_anything_else_the_last_holds() -> None:
    given = {"speeds_mm_s": ["1,2", "1cm/s"], "cycles": ["7", "8"], "label": None, "ratio": []}
    assert texts_of(Example, given) == {"speeds_mm_s": "1,2,1cm/s", "cycles": "8"}


class OfAnotherPackage(Settings):
    """Settings of kinds that this project's procedures do not have."""

    gentle: bool = True
    """Gently."""
    words: tuple[str, ...] = ("up", "down")
    """Words."""
    more_N: tuple[float, ...] | None = None
    """Forces."""
    side: Literal[1, 2] = 1
    """Side."""


def test_a_switch_that_is_on_can_be_turned_off() -> None:
    (on,) = (one for one in parameters(OfAnotherPackage) if one.name == "gentle")
    option = on.annotation.__metadata__[0]
    assert option.default == "--gentle/--no-gentle"  # typer: the first name of the option
    assert option.help == "Gently.  [default: on]"
    given = texts_of(OfAnotherPackage, {"gentle": False, "words": None})
    assert given == {"gentle": "false"}
    assert settings_from(OfAnotherPackage, given).gentle is False  # type: ignore[attr-defined]


def test_lists_of_texts_optional_lists_and_choices_of_numbers_can_be_given() -> None:
    helps = {one.name: one.annotation.__metadata__[0].help for one in parameters(OfAnotherPackage)}
    assert helps["words"] == "Words.  [default: up, down]"
    texts = texts_of(OfAnotherPackage, {"words": ["a"], "more_N": ["2", "3 N"], "side": ["2"]})
    found: Any = settings_from(OfAnotherPackage, texts)
    assert (found.words, found.more_N, found.side) == (("a",), (2.0, 3.0), 2)
    with pytest.raises(ConfigurationError, match="--side 3: must be 1 or 2"):
        settings_from(OfAnotherPackage, {"side": "3"})


def test_a_seed_beside_a_bench_file_is_refused(rig) -> None:
    (rig.folder / "bench.toml").write_text("")
    ended = rig.run("slip-trial", "--seed", "5")
    assert ended.code == ExitCode.USAGE
    assert (
        "--seed 5 belongs to a simulated bench that this command starts, not to bench.toml"
        in (ended.errors[0])
    )
