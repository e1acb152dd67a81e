"""A press is compared with earlier runs of its kind on the bench."""

from __future__ import annotations

import json
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest

from procedures.pressed.approach.earlier_runs import EarlierPress
from procedures.pressed.approach.tare import ForceZero
from rig.bench.plan import parse_bench
from rig.core.errors import ConfigurationError, InstrumentError, RigError
from rig.run.press_references import FILE, PressReferences, TouchGain

BENCH = """
name = "bench-1"
[fixture]
mounted = "plate"
contact_from_mm = 12.0
contact_to_mm = 13.0
[skin]
name = "{skin}"
[daq]
driver = "keysight-u2300a"
resource = "TCPIP::127.0.0.1::hislip0,1::INSTR"
channels = {{ strip_1 = 101, strip_2 = 102 }}
[stage_z]
driver = "festo-cmmt"
axis = "z"
host = "127.0.0.20"
low_limit_mm = 0.0
high_limit_mm = 20.0
max_speed_mm_s = 20.0
torque_limit_percent = 25.0
[force_sensor]
driver = "me-gsv8"
port = "{port}"
"""
SIMULATED = "[simulation]\nseed = 1\n"
ZERO = ForceZero(1.0, -0.5, 1.8)
WAY_mm, STIFFNESS_N_mm = 0.033, 142.0


@pytest.fixture(autouse=True)
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that all users of the bench share, of this test alone."""
    folder = tmp_path / "shared"
    monkeypatch.setenv("RIG_SHARED_FOLDER", str(folder))
    return folder


class Run:
    """A run that knows its references, and notes what is said."""

    def __init__(
        self,
        folder: Path,
        skin: str = "skin 1",
        accept: str = "",
        port: str = "/dev/ttyUSB0",
        more: str = "",
        begun: str | None = None,
    ):
        plan = parse_bench(BENCH.format(skin=skin, port=port) + more, "bench.toml")
        self.references = PressReferences(folder, plan, "", accept, begun)
        self.bench = SimpleNamespace(stage_z=SimpleNamespace(stop=lambda: None))
        self.said: list[tuple[str, str]] = []

    def event(self, level: str, code: str, message: str) -> None:
        self.said.append((level, message))

    def press(
        self,
        way_mm: float = WAY_mm,
        stiffness_N_mm: float = STIFFNESS_N_mm,
        zero: ForceZero = ZERO,
        force_N: float = 4.0,
    ) -> None:
        earlier = EarlierPress(self, force_N, "glass plate")  # type: ignore[arg-type]
        earlier.refuse_way(way_mm, 0.9 * force_N)
        earlier.judge(way_mm, stiffness_N_mm, zero)
        self.references.keep()

    def touch(self, value_V_s_N: float, error_V_s_N: float = 1e-6) -> None:
        """Press, and judge the touch gain of one strip."""
        self.press()
        gain = TouchGain(value_V_s_N=value_V_s_N, error_V_s_N=error_V_s_N)
        earlier = EarlierPress(self, 4.0, "glass plate")  # type: ignore[arg-type]
        earlier.judge_gains({"strip_1": gain})
        self.references.keep()


def test_a_first_run_says_once_that_it_has_nothing_to_compare_with(tmp_path: Path) -> None:
    first, second = Run(tmp_path), Run(tmp_path)
    first.press()
    first.press(way_mm=1.2 * WAY_mm, stiffness_N_mm=1.3 * STIFFNESS_N_mm)
    second.press()
    ((level, said),) = first.said
    assert level == "info"
    assert "there was nothing to compare it with" in said
    assert second.said == []


def test_a_press_of_a_run_that_is_not_kept_is_no_reference(tmp_path: Path, shared: Path) -> None:
    run = Run(tmp_path)
    EarlierPress(run, 4.0, "glass plate").judge(WAY_mm, 20.0, ZERO)  # type: ignore[arg-type]
    assert not list(shared.glob(f"*{FILE}")), "nothing is written while it presses"
    with pytest.raises(InstrumentError):
        run.press(stiffness_N_mm=3 * 20.0)
    Run(tmp_path).press()


def test_a_folder_that_takes_no_reference_is_named(tmp_path: Path, shared: Path) -> None:
    run = Run(tmp_path)
    run.press()
    (file,) = shared.glob(f"*{FILE}")
    file.unlink()
    file.with_name(f".{file.name}.part").mkdir()
    with pytest.raises(RigError, match="no reference for later presses was saved to"):
        run.references.keep()


@pytest.mark.parametrize("ratio", [1 / 3, 3.0])
def test_another_stiffness_is_refused_beyond_its_factor(tmp_path: Path, ratio: float) -> None:
    Run(tmp_path).press()
    with pytest.raises(InstrumentError, match="had 142 N/mm") as caught:
        Run(tmp_path).press(stiffness_N_mm=ratio * STIFFNESS_N_mm)
    assert "make one run of this kind with --accept REASON" in str(caught.value.hint)


def test_what_fits_badly_is_a_warning(tmp_path: Path) -> None:
    Run(tmp_path).press()
    run = Run(tmp_path)
    run.press(stiffness_N_mm=1.8 * STIFFNESS_N_mm, zero=ForceZero(1.0, 1.0, 1.8))
    ((level, said),) = run.said
    assert level == "warning"
    assert "had 142 N/mm" in said
    assert "the force sensor's zero is 1.5 N away from where it was in earlier runs" in said


@pytest.mark.parametrize(("way_mm", "force_N"), [(0.045, 1.2), (0.11, 3.0)])
def test_a_way_without_its_force_is_refused_while_z_goes(
    tmp_path: Path, way_mm: float, force_N: float
) -> None:
    Run(tmp_path).press()
    earlier = EarlierPress(Run(tmp_path), 4.0, "glass plate")  # type: ignore[arg-type]
    earlier.refuse_way(0.04, 0.5)
    earlier.refuse_way(0.09, 2.0)
    with pytest.raises(InstrumentError, match=r"had 4 N after 0\.033 mm"):
        earlier.refuse_way(way_mm, force_N)


def test_an_object_that_is_not_felt_again_ends_the_approach_soon_below_its_place(
    tmp_path: Path,
) -> None:
    run = Run(tmp_path)
    run.press()
    earlier = EarlierPress(run, 4.0, "glass plate")  # type: ignore[arg-type]
    earlier.refuse_missed(2 * WAY_mm, 0.01)
    with pytest.raises(InstrumentError, match=r"0\.01 N, 0\.110 mm below where this run") as caught:
        earlier.refuse_missed(0.11, 0.01)
    assert caught.value.device == "force_sensor"
    nothing_known = EarlierPress(Run(tmp_path / "b", skin="skin 2"), 4.0, "")  # type: ignore[arg-type]
    nothing_known.refuse_missed(0.5, 0.01)


def test_another_kind_of_run_is_not_compared(tmp_path: Path) -> None:
    Run(tmp_path).press()
    Run(tmp_path, skin="skin 2").press(stiffness_N_mm=10 * STIFFNESS_N_mm)
    Run(tmp_path).press(stiffness_N_mm=10 * STIFFNESS_N_mm, force_N=8.0)


def test_an_accepted_run_becomes_the_reference_with_its_reason(
    tmp_path: Path, shared: Path
) -> None:
    Run(tmp_path).press()
    accepted = Run(tmp_path, accept="a softer pad")
    accepted.press(way_mm=0.2, stiffness_N_mm=20.0)
    accepted.press(way_mm=0.2, stiffness_N_mm=21.0)
    ((_, said),) = accepted.said
    assert "accepted: a softer pad" in said
    Run(tmp_path).press(way_mm=0.2, stiffness_N_mm=20.0)
    with pytest.raises(InstrumentError):
        Run(tmp_path).press()
    (file,) = shared.glob(f"*{FILE}")
    assert "a softer pad" in file.read_text()


@pytest.mark.parametrize(
    ("gain_V_s_N", "error_V_s_N", "found"),
    [
        (3.6e-4, 1e-6, None),
        (5.5e-4, 1e-6, "warning"),
        (5.5e-4, 1e-4, None),
        (1e-6, 1e-6, "refused"),
        (-3e-4, 1e-6, "refused"),
        (9e-4, 1e-6, "refused"),
        (9e-4, 1e-4, "warning"),
    ],
)
def test_a_touch_gain_is_compared_as_far_as_its_error_allows(
    tmp_path: Path, gain_V_s_N: float, error_V_s_N: float, found: str | None
) -> None:
    Run(tmp_path).touch(3e-4)
    run = Run(tmp_path)
    if found == "refused":
        with pytest.raises(InstrumentError, match=r"strip_1 is .* was 0\.0003 V s/N") as caught:
            run.touch(gain_V_s_N, error_V_s_N)
        assert "check the strip's cable" in str(caught.value.hint)
        assert "--accept REASON" in str(caught.value.hint)
    else:
        run.touch(gain_V_s_N, error_V_s_N)
    assert [level for level, _ in run.said] == ([found] if found == "warning" else [])


def test_a_touch_gain_that_cannot_be_distinguished_from_nothing_is_no_reference(
    tmp_path: Path,
) -> None:
    Run(tmp_path).touch(1e-6, 1e-6)
    Run(tmp_path).touch(3e-4)
    with pytest.raises(InstrumentError):
        Run(tmp_path).touch(9e-4)


def test_an_accepted_run_sets_the_touch_gain_too(tmp_path: Path) -> None:
    Run(tmp_path).touch(3e-4)
    Run(tmp_path, accept="another amplifier").touch(3e-3)
    Run(tmp_path).touch(3e-3)
    with pytest.raises(InstrumentError):
        Run(tmp_path).touch(3e-4)


def test_references_belong_to_the_bench_and_not_to_the_folder_of_results(tmp_path: Path) -> None:
    Run(tmp_path / "one").press()
    with pytest.raises(InstrumentError):
        Run(tmp_path / "another").press(stiffness_N_mm=3 * STIFFNESS_N_mm)
    Run(tmp_path, port="/dev/ttyUSB1").press(stiffness_N_mm=3 * STIFFNESS_N_mm)
    assert not (tmp_path / "one").exists()


def test_a_simulated_bench_sets_nothing_that_a_real_one_is_compared_with(
    tmp_path: Path, shared: Path
) -> None:
    Run(tmp_path, more=SIMULATED).press(stiffness_N_mm=3 * STIFFNESS_N_mm)
    assert (tmp_path / FILE).exists()
    assert not list(shared.glob(f"*{FILE}"))
    first = Run(tmp_path)
    first.press()
    assert "there was nothing to compare it with" in first.said[0][1]


def test_a_file_that_cannot_be_read_is_reported_with_the_way_out(
    tmp_path: Path, shared: Path
) -> None:
    Run(tmp_path).press()
    (file,) = shared.glob(f"*{FILE}")
    file.write_text("{")
    with pytest.raises(ConfigurationError, match="cannot be read") as caught:
        Run(tmp_path).press()
    assert "remove it" in str(caught.value.hint)


def test_a_resumed_run_with_a_reason_is_compared_with_its_own_presses_only(tmp_path: Path) -> None:
    Run(tmp_path).press()
    begun = datetime.now().astimezone() + timedelta(seconds=10)
    before = Run(tmp_path, accept="a stiffer clamp", begun=begun.isoformat())
    before.press(stiffness_N_mm=4 * STIFFNESS_N_mm)
    (file,) = (tmp_path / "shared").glob(f"*{FILE}")
    known = json.loads(file.read_text())
    (own,) = known["references"].values()
    own["time"] = (begun + timedelta(seconds=20)).strftime("%Y-%m-%d %H:%M:%S")
    file.write_text(json.dumps(known))
    resumed = Run(tmp_path, accept="a stiffer clamp", begun=begun.isoformat())
    resumed.press(stiffness_N_mm=4 * STIFFNESS_N_mm)
    with pytest.raises(InstrumentError, match="had 568 N/mm"):
        Run(tmp_path, accept="a stiffer clamp", begun=begun.isoformat()).press()
