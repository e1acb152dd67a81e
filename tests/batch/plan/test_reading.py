"""The batch file as people write it, and as strangers do."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from rig.batch.plan.findings import BatchText
from rig.batch.plan.read import parse_batch, read_batch
from rig.core.errors import ConfigurationError, ExitCode
from rig.core.toml_files import MAX_TOML_BYTES, MAX_TOML_LINE

GOOD = """\
[batch]
name = "night"
not_before = 22:00:00
stop_by = 2026-11-23T07:00:00+01:00

[defaults.slip-trial]
normal_force_N = "4 N"

[[experiment]]
procedure = "slip-trial"
repeat = 2
[experiment.matrix]
speed_mm_s = [
    0.2,  # slow
    0.5,
]
rest_s = [0.3, "1 min"]
[[experiment.exclude]]
speed_mm_s = 0.5
rest_s = 60

[[experiment]]
procedure = "sweep"
every = 3
settings = { frequencies_Hz = [200, "1 kHz"], load_N = 1 }
"""


def refused(text: str) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        parse_batch(text, "night.toml")
    assert caught.value.code is ExitCode.USAGE
    return [part.one_line() for part in caught.value.parts()]


def test_a_whole_file_is_read_and_expanded(tmp_path: Path) -> None:
    path = tmp_path / "night.toml"
    path.write_text(GOOD)
    batch, plan, source = read_batch(path)
    assert batch.batch.name == "night"
    assert [run.condition for run in plan.runs] == [
        "sweep-001", "slip-trial-001", "slip-trial-002", "slip-trial-003", "sweep-001",
        "slip-trial-001", "slip-trial-002", "slip-trial-003", "sweep-001",
    ]  # fmt: skip
    assert plan.conditions["slip-trial-002"].varied == {"speed_mm_s": 0.2, "rest_s": 60.0}
    assert source.line(("experiment", 1, "settings", "load_N")) == 25


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ('name = "night"', 'name = ""', 2, "batch.name = '': must have 1 or more characters"),
        ("not_before = 22:00:00", 'not_before = "late"', 3, "batch.not_before = 'late': "),
        ("repeat = 2", "repeat = 0", 11, "experiment 1: repeat = 0: must be at least 1"),
        ("repeat = 2", "repeats = 2", 11, "experiment 1: repeats: unknown key"),
        ("    0.5,\n]", "    -0.5,\n]", 13, "experiment 1: matrix.speed_mm_s = -0.5 mm/s: must"),
        ("    0.5,\n]", "    [1],\n]", 13, "experiment 1: matrix.speed_mm_s: an entry must be"),
        ('"1 min"', '"1 m"', 17, "experiment 1: matrix.rest_s = '1 m': 'm' does not convert to s"),
        ("rest_s = 60", "pause_s = 60", 20, "experiment 1: exclude.pause_s: the procedure has no"),
        ('"4 N"', '"4 kg"', 7, "defaults.slip-trial.normal_force_N = '4 kg': "),
        ('"4 N"', "-4", 7, "defaults.slip-trial.normal_force_N = -4 N: must be above 0 N"),
        ("load_N = 1 ", "load_N = 0 ", 25, "experiment 2: settings.load_N = 0 N: must be above"),
        ('= "sweep"', '= "swoop"', 23, "experiment 2: procedure = 'swoop' is unknown"),
        ("every = 3", "every = 3\nrepeat = 3", 22, "experiment 2: a reference (every) is one"),
        ("[batch]", "[bitch]", 1, "batch: missing"),
    ],
)
def test_an_error_is_reported_with_its_line(old: str, new: str, line: int, words: str) -> None:
    assert old in GOOD
    lines = refused(GOOD.replace(old, new))
    place = f"night.toml:{line}: {words}"
    assert any(one.startswith(place) for one in lines), (place, lines)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("7", "stop_by = 7: must be a time of day (07:00:00) or a date and time (2026-11-24 "),
        ("2026-11-24", "stop_by = 2026-11-24: must be a time of day (07:00:00)"),
        ('"07:00:00+02:00"', "a time of day is in this computer's time zone: write 07:00:00"),
        ('"7 am"', "stop_by = '7 am': write a time of day (07:00:00) or a date and time (2026-11"),
        ('"7"', "stop_by = '7': write a time of day (07:00:00)"),
    ],
)
def test_what_is_not_a_time_is_refused_with_how_to_write_one(value: str, words: str) -> None:
    (line,) = refused(GOOD.replace("2026-11-23T07:00:00+01:00", value))
    assert words in line


def test_the_bound_of_a_sample_in_another_unit_is_refused_with_its_setting() -> None:
    sample = '[experiment.sample]\npoints = 3\nranges = { speed_mm_s = ["1 N", 2] }\n'
    found = refused('[batch]\nname = "b"\n[[experiment]]\nprocedure = "slip-trial"\n' + sample)
    assert found == [
        "night.toml:7: experiment 1: sample.ranges: "
        "speed_mm_s = '1 N': 'N' does not convert to mm/s"
    ]


@pytest.mark.parametrize("key", ["user", "sample"])
def test_a_name_that_no_run_file_could_hold_is_refused_before_the_night(key: str) -> None:
    text = f'[batch]\nname = "b"\n{key} = "{"x" * 1001}"\n[[experiment]]\nprocedure = "sweep"\n'
    assert refused(text) == [f"night.toml:3: batch.{key}: must have at most 1000 characters"]


def test_stages_that_no_simulated_bench_has_are_refused_with_the_choices() -> None:
    (line,) = refused(GOOD + '[simulation]\nstages = "hexapod"\n')
    assert line.startswith("night.toml:27: simulation.stages = 'hexapod': must be one of festo, ")
    batch, _, _ = parse_batch(GOOD + '[simulation]\nstages = "az-festo"\n', "night.toml")
    assert batch.simulation is not None
    assert batch.simulation.stages == "az-festo"


def test_errors_of_file_and_settings_are_reported_together_in_the_order_of_the_file() -> None:
    broken = (
        GOOD.replace('"night"', '""').replace('"1 min"', '"1 m"').replace("every = 3", "every=0")
    )
    lines = refused(broken.replace("    0.2,", "    0,"))
    assert [int(re.match(r"night\.toml:(\d+): ", line)[1]) for line in lines] == [2, 13, 17, 24]  # type: ignore[index]


def test_what_is_no_toml_is_reported_with_its_line() -> None:
    (line,) = refused("[batch]\nname = \n")
    assert "night.toml" in line
    assert "line 2" in line


def test_more_errors_than_anybody_reads_are_counted() -> None:
    lines = refused(GOOD + "".join(f"key{k} = 1\n" for k in range(100)))
    assert len(lines) == 21
    assert lines[-1] == "and 80 more"


def test_every_key_and_table_of_a_file_has_its_line() -> None:
    text = textwrap.dedent(
        """\
        top = 1
        a.b."c d".'e' = [1, 2,
            # nothing
            [3,
             4]]
        [x . "y"]  # a comment
        z = { p = 1 }
        [[list]]
        k = 1
        [[list.inner]]
        [[list.inner]]
        v = 2
        [list.sub]
        w = 3
        [[list]]
          [[list.inner]]
          v = 3
        """
    )
    expected = {
        ("top",): 1,
        ("a", "b", "c d", "e"): 2,
        ("a", "b", "c d", "e", 2, 1): 2,
        ("x", "y"): 6,
        ("x", "y", "z", "p"): 7,
        ("list",): 8,
        ("list", 0): 8,
        ("list", 0, "k"): 9,
        ("list", 0, "inner", 0): 10,
        ("list", 0, "inner", 1): 11,
        ("list", 0, "inner", 1, "v"): 12,
        ("list", 0, "sub"): 13,
        ("list", 0, "sub", "w"): 14,
        ("list", 1): 15,
        ("list", 1, "inner", 0, "v"): 17,
        ("elsewhere",): 1,
    }
    source = BatchText("night.toml", text)
    assert {where: source.line(where) for where in expected} == expected


# --- from strangers ---------------------------------------------------------------------------

VALUES = st.sampled_from(
    [
        *("0", "-1", "1e308", "-1e308", "5e-324", "nan", "inf", "true", '""', "[]", "{}", "[[]]"),
        *("9223372036854775807", "9" * 400, "[1, 'a']", "{ a = { a = 1 } }", "1979-05-27"),
        *("22:00:00", '"slip-trial"', '"sweep"', '"' + "x" * 5000 + '"', "[0, 1, 2]", "[0.5]"),
        *('"4 N"', '"4 parsec"', '"nan"', '["1 mm/s", "2 mm/s"]', "[{ speed_mm_s = 1 }]"),
        *('{ speed_mm_s = [1, 2] }', '{ ranges = { speed_mm_s = [0.1, 1] }, points = 3 }'),
        *('{ ranges = { trials = [-1e308, 1e308] }, points = 3, method = "sobol" }',),
        *("{ speed_mm_s = 1 }", '"blocked"', '["rest_s"]', '"\\u001b[31m"', '"a\\u0000b"'),
    ]
)  # fmt: skip
KEYS = st.sampled_from(
    [
        *(
            "name",
            "order",
            "seed",
            "stop_by",
            "results",
            "procedure",
            "matrix",
            "sample",
            "include",
        ),
        *("exclude", "repeat", "block_by", "every", "drift", "rest_s", "settings", "speed_mm_s"),
        *("trials", "loading", "x", '"a b"', "a.b", "matrix.trials", "settings.rest_s", "points"),
    ]
)
TABLES = st.sampled_from(
    [
        *("[batch]", "[[experiment]]", "[experiment.matrix]", "[defaults.sweep]", "[defaults]"),
        *("[[experiment.include]]", "[[experiment.exclude]]", "[experiment.sample]", "[x.y]"),
        *("[simulation]", "[[simulation.fault]]", "[experiment.sample.ranges]", "[experiment]"),
    ]
)
LINES = st.one_of(
    TABLES,
    st.builds("{} = {}".format, KEYS, VALUES),
    st.sampled_from(['procedure = "slip-trial"', 'name = "night"', "# nothing", "\t\r"]),
    st.text(max_size=20),
)


def taken_or_refused(text: str) -> None:
    """What it may never do is crash or hang: the test's time-out ends it then."""
    error = None
    try:
        parse_batch(text, "night.toml")
    except ConfigurationError as refusal:
        error = refusal
    if error is not None:
        assert error.code is ExitCode.USAGE
        assert "night.toml" in error.message
        assert len(error.one_line()) < 20_000


@settings(max_examples=30, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(LINES, max_size=12).map("\n".join))
@example("experiment = 5")
@example("defaults = []\nexperiment = [1, {}]")
@example("[batch]\nname='a'\n[[experiment]]\nprocedure='sweep'\n[[experiment.exclude]]\n")
def test_lines_of_any_kind_are_taken_or_refused(text: str) -> None:
    taken_or_refused(text)


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_a_file_in_which_something_is_corrupt_is_taken_or_refused(data: st.DataObject) -> None:
    lines = GOOD.splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(lines) - 1))
        lines[place] = data.draw(LINES)
    taken_or_refused("\n".join(lines))


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 4000,
        "a = " + "{ a = " * 1000 + "1" + " }" * 1000,
        ".".join("a" * ((MAX_TOML_LINE - 100) // 2)) + " = 1",
        '[[experiment]]\nprocedure="sweep"\n' * (MAX_TOML_BYTES // 40),
        "[[experiment]]\n" * (MAX_TOML_BYTES // 20),
        "".join(f"[defaults.a{k}]\n" for k in range(3000)),
        "".join(f"k{k} = 1\n" for k in range(5000)),
        "#" * (MAX_TOML_BYTES + 1),
        pytest.param(
            GOOD.replace("repeat = 2", "repeat = 99999").replace("every = 3", "every = 1"),
            marks=pytest.mark.thorough,
        ),
        GOOD + "[[experiment.exclude]]\nrest_s = 1\n" * 1000,
    ],
    ids=[
        *("lists", "tables", "a long name", "experiments", "empty experiments", "defaults", "keys"),
        *("a long file", "a long queue", "exclusions"),
    ],
)
def test_files_beyond_sense_are_taken_or_refused(text: str) -> None:
    taken_or_refused(text)


def test_the_refusal_of_a_file_without_experiments_names_the_key() -> None:
    assert refused('[batch]\nname = "x"\n') == ["night.toml:1: experiment: missing"]


def test_an_experiment_that_is_wrong_is_not_reported_as_missing_too() -> None:
    lines = refused('[batch]\nname = "x"\n[[experiment]]\nprocedure = "sweep"\nrepeats = 2\n')
    assert lines == ["night.toml:5: experiment 1: repeats: unknown key"]
