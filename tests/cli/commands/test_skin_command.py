"""``rig skin``: figures that say they are simulated, data on stdout, refusals as one error."""

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

import rig
from rig.cli.app import build
from rig.cli.commands.skin import app
from rig.files.definitions import definition_path

SHORT = {
    "press": {"normal_force_N": 1.0, "loading_s": 0.05, "rest_s": 0.02},
    "slide_s": 0.1,
}


@pytest.fixture(scope="module")
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache that the tests share: each skin is computed once."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def own_cache(cache_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RIG_CACHE", str(cache_folder))


def run(*arguments: str) -> str:
    result = CliRunner().invoke(app, list(arguments), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def refused(*arguments: str) -> str:
    """What stderr says of a command line that is refused."""
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == 2
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    return line


@pytest.fixture(scope="module")
def kept(cache_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """The data of a slide on a skin of 4 elements a ridge, and the summary that was printed."""
    folder = tmp_path_factory.mktemp("slide")
    (folder / "slide.json").write_text(json.dumps(SHORT))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RIG_CACHE", str(cache_folder))
        arguments = ("slide", "--settings", str(folder / "slide.json"), "--elements", "4", "--json")
        summary = json.loads(run(*arguments, "--results", str(folder)))
    return folder / "skin-slide.h5", summary


@pytest.fixture(scope="module")
def kept_slide(kept: tuple[Path, dict]) -> Path:
    """The file of that slide."""
    return kept[0]


@pytest.mark.thorough
def test_a_slide_from_edited_settings_is_drawn_and_summed_up(kept: tuple[Path, dict]):
    _, summary = kept
    assert summary["simulated"] is True
    names = [Path(f).name for f in summary["files"]]
    assert names == [
        "skin-slide.h5",
        "skin-slide.png", "skin-slide.svg", "skin-slide-deformed.png", "skin-slide-deformed.svg",
    ]  # fmt: skip
    for file in summary["files"]:
        begins = {"png": b"\x89PNG", "svg": b"<?xml", ".h5": b"\x89HDF"}[file[-3:]]
        assert Path(file).read_bytes().startswith(begins)
    assert len(summary["ridge_whole_slip_s"]) == 9


@pytest.mark.thorough
def test_the_data_of_a_slide_are_kept_and_explain_themselves(
    kept: tuple[Path, dict], tmp_path: Path
):
    kept_slide, summary = kept
    with h5py.File(kept_slide) as file:
        entry = file["entry"]
        assert entry["title"][()].decode().startswith("SIMULATED Slide at 0.5 mm/s")
        assert entry["program_name"].attrs["version"] == rig.__version__
        data = entry["data"]
        for name, field in data.items():
            assert field.attrs["long_name"], name
            assert "units" in field.attrs or name in ("status",), name
            assert len(field.attrs.get("axes", ())) == field.ndim, name
        assert data["F_n"].attrs["units"] == "N"
        assert data["F_n"].shape == data["time"].shape
        moving = data["sample_time"][:] > data["motion"][()]
        np.testing.assert_allclose(
            1e3 * data["v_d"][:][moving].min(), summary["v_d_min_mV"], rtol=1e-6
        )
        again = json.loads(entry["settings_json/data"][()])
        assert again["skin"]["elements_per_ridge"] == 4
        assert entry["parameters/settings/speed_mm_s"].attrs["units"] == "mm/s"
    (tmp_path / "again.json").write_text(json.dumps(again["settings"]))
    shown = run("slide", "--settings", str(tmp_path / "again.json"), "--show-settings")
    assert json.loads(shown) == again["settings"], "the settings can be given back"


def invoked(*arguments: str | Path) -> Result:
    """What a command of `rig` has done."""
    words = list(map(str, arguments))
    return CliRunner().invoke(build(words), words)


def shown(*arguments: str | Path) -> str:
    """What a command of `rig` prints on stdout."""
    result = invoked(*arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.mark.thorough
def test_rig_show_sums_up_what_was_computed(kept_slide: Path):
    said = shown("show", kept_slide)
    assert "title: SIMULATED Slide at 0.5 mm/s under 1 N" in said
    assert f"program: rig skin {rig.__version__}" in said
    settings, results = said.split("results:")
    assert "skin.elements_per_ridge 4" in settings
    assert "settings.press.loading_s 0.05" in settings
    assert "speed_mm_s" not in settings, "it has its default"
    assert "speed_mm_s: 0.5" in shown("show", "--all", kept_slide)
    assert re.search(r"  F_n: \d+ over time: \S+ to 1\S* N \(normal force\)", results)
    everything = shown("show", "--all", kept_slide)
    assert re.search(r"  ridge_whole_slip: (\S+; ){8}\S+ s \(slip of the whole ridge\)", everything)


def test_rig_show_gives_it_to_programs(kept_slide: Path):
    said = json.loads(shown("show", "--json", kept_slide))
    assert said["simulated"] is True
    assert said["settings"]["skin"]["elements_per_ridge"] == 4
    with h5py.File(kept_slide) as file:
        force = file["entry/data/F_n"][:]
        slips = file["entry/data/ridge_whole_slip"][:]
    found = said["results"]["F_n"]
    assert (found["lowest"], found["highest"]) == (force.min(), force.max())
    assert found["unit"] == "N"
    assert found["shape"] == f"{force.size} time"
    expected = [value if np.isfinite(value) else None for value in slips]
    assert said["results"]["ridge_whole_slip"]["values"] == expected


def test_rig_verify_knows_such_a_file(kept_slide: Path, tmp_path: Path):
    assert "sound (rig skin" in shown("verify", kept_slide)
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes(kept_slide.read_bytes().replace(b"long_name", b"lang_name"))
    result = invoked("show", damaged)
    assert result.exit_code == 8
    assert "not a readable file of rig skin" in result.stderr


def test_nexusformat_finds_nothing_in_such_a_file(kept_slide: Path):
    from nexusformat.nexus.validate import lint_nxdl, validate_application, validate_file

    definition = definition_path("NXrig_model")
    assert lint_nxdl(definition) == []
    assert validate_file(str(kept_slide)) == (0, 0)
    assert validate_application(str(kept_slide), application=str(definition)) == (0, 0)


def test_another_programs_file_is_still_refused_clearly(tmp_path: Path):
    with h5py.File(tmp_path / "theirs.h5", "w") as file:
        file["x"] = [1, 2]
    result = invoked("show", tmp_path / "theirs.h5")
    assert result.exit_code == 8
    assert "an HDF5 file, but not a run file: it has no journal header" in result.stderr


@pytest.mark.parametrize("taken", ["skin-slide.h5", "skin-slide-deformed.svg"])
@pytest.mark.thorough
def test_neither_data_nor_figures_are_overwritten(tmp_path: Path, taken: str):
    (tmp_path / taken).write_text("mine")
    settings = tmp_path / "slide.json"
    settings.write_text(json.dumps(SHORT))
    said = run("slide", "--settings", str(settings), "--elements", "4", "--results", str(tmp_path))
    assert (tmp_path / taken).read_text() == "mine"
    assert f"{tmp_path}/skin-slide-2.h5" in said
    assert f"{tmp_path}/skin-slide-deformed-2.svg" in said


@pytest.mark.thorough
def test_a_roll_is_drawn(tmp_path: Path):
    settings = tmp_path / "roll.json"
    settings.write_text(json.dumps({"press": SHORT["press"], "roll_s": 0.1, "settle_s": 0.02}))
    said = run("roll", "--settings", str(settings), "--elements", "4", "--results", str(tmp_path))
    assert said.startswith("simulated (model)\n")
    assert (tmp_path / "skin-roll.png").exists()


@pytest.mark.thorough
def test_shown_settings_can_be_given_back(tmp_path: Path):
    shown = run("history", "--show-settings", "--relief", "tangential_lowered")
    edited = json.loads(shown)
    assert [p["step"] for p in edited["loads"]] == [0, 140, 200, 300, 340, 380, 480, 550]
    edited["skin"].update(ridges=3, elements_per_ridge=3)
    file = tmp_path / "history.json"
    file.write_text(json.dumps(edited))
    said = json.loads(run("history", "--settings", str(file), "--results", str(tmp_path), "--json"))
    assert said["stable_step_us"] > 0.5
    assert all(Path(f).exists() for f in said["files"])


@pytest.mark.thorough
def test_the_skin_itself_can_be_edited(tmp_path: Path):
    shown = json.loads(run("slide", "--show-skin", "--elements", "4"))
    assert shown["elements_per_ridge"] == 4
    shown["ridges"] = 5
    (tmp_path / "skin.json").write_text(json.dumps(shown))
    (tmp_path / "slide.json").write_text(json.dumps(SHORT))
    said = run(
        "slide", "--skin", str(tmp_path / "skin.json"), "--results", str(tmp_path), "--json",
        "--settings", str(tmp_path / "slide.json"), "--at", "0.07", "--at", "0.1",
    )  # fmt: skip
    assert len(json.loads(said)["ridge_whole_slip_s"]) == 5
    shown["poissons_ratio"] = 0.5
    (tmp_path / "skin.json").write_text(json.dumps(shown))
    line = refused("slide", "--skin", str(tmp_path / "skin.json"))
    assert "skin.json" in line
    assert "poissons_ratio 0.5 (no unit) must be at least 0 and below 0.5" in line


@pytest.mark.thorough
def test_a_sphere_rolls_and_has_no_section_to_draw(tmp_path: Path):
    settings = tmp_path / "roll.json"
    body = {"shape": "sphere", "slices": 2}
    edited = {"press": SHORT["press"], "roll_s": 0.1, "settle_s": 0.02, "body": body}
    settings.write_text(json.dumps(edited))
    run("roll", "--settings", str(settings), "--elements", "4", "--results", str(tmp_path))
    assert (tmp_path / "skin-roll.png").exists()
    assert not (tmp_path / "skin-roll-deformed.png").exists()


@pytest.mark.thorough
def test_every_figure_says_that_it_is_simulated(tmp_path: Path, monkeypatch):
    from rig.figures import style

    kept = []

    def keep(figure, path, simulated):
        assert simulated
        kept.append(figure)
        return [path]

    monkeypatch.setattr(style, "save", keep)
    settings = tmp_path / "slide.json"
    settings.write_text(json.dumps(SHORT))
    run("slide", "--settings", str(settings), "--elements", "4", "--results", str(tmp_path))
    small = {
        "skin": {"ridges": 3, "elements_per_ridge": 4},
        "slide": {**SHORT, "ridge": 2},
        "offsets_mm": [0.35],
        "bottoms_mm": [0.0],
    }
    settings.write_text(json.dumps(small))
    run("map", "--settings", str(settings), "--results", str(tmp_path))
    file = tmp_path / "history.json"
    file.write_text(
        json.dumps({"skin": {"ridges": 3, "elements_per_ridge": 3, "refinement": "uniform"}})
    )
    run("history", "--settings", str(file), "--results", str(tmp_path))
    assert len(kept) == 5
    for figure in kept:
        assert "simulated (model)" in figure._suptitle.get_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["slide", "--normal-force", "-1"],
            "--normal-force -1: must be above 0 N",
        ),
        (["slide", "--normal-force", "4s"], "--normal-force 4s: 's' does not convert to N"),
        (["slide", "--speed", "0"], "--speed 0: must be above 0 mm/s"),
        (["slide", "--speed", "nan"], "--speed nan: must be a finite number"),
        (["roll", "--start", "inf"], "--start inf: must be a finite number"),
        (
            ["roll", "--start", "1e9mm"],
            "--start 1e9mm: an object with a radius of 30 mm touches no ridge there; the",
        ),
        (["slide", "--at", "soon"], "--at soon"),
        (["roll", "--shape", "cone"], "--shape cone: must be one of cylinder, sphere"),
        (["history", "--relief", "none"], "--relief none: must be one of normal_raised"),
        (["slide", "--settings", "nowhere.json"], "nowhere.json: No such file"),
        (["history", "--at", "600"], "--at 600 (a step) must lie between 1 and 550"),
        (["slide", "--elements", "2", "--at", "9s"], "--at 9 s must lie between 0 s and 0.8501 s"),
        (["history", "--at", "1.5"], "--at 1.5 (a step) must be a whole number"),
        (
            ["slide", "--show-settings", "--show-skin"],
            "--show-settings and --show-skin print one object each; give one of them",
        ),
        (["map", "--settings", "/dev/null"], "/dev/null: not a regular file"),
    ],
)
def test_what_cannot_be_is_one_error_that_says_why(arguments, words):
    assert words in refused(*arguments)


def test_options_take_units_as_those_of_procedures_do():
    shown = run("slide", "--show-settings", "--normal-force", "3500mN", "--speed", "0.1cm/s")
    assert json.loads(shown)["press"]["normal_force_N"] == 3.5
    assert json.loads(shown)["speed_mm_s"] == pytest.approx(1.0)
    shown = run("roll", "--show-settings", "--start", "-0.6cm")
    assert json.loads(shown)["start_x_mm"] == pytest.approx(-6.0)


@pytest.mark.nightly
def test_earlier_figures_are_never_overwritten(tmp_path: Path):
    small = {"skin": {"ridges": 3, "elements_per_ridge": 3, "refinement": "uniform"}, "ridge": 2}
    file = tmp_path / "history.json"
    file.write_text(json.dumps(small))
    arguments = ("history", "--settings", str(file), "--results", str(tmp_path))
    first = run(*arguments)
    kept = (tmp_path / "skin-history-normal_raised.png").read_bytes()
    second = run(*arguments)
    assert "skin-history-normal_raised-deformed.svg" in first
    assert "skin-history-normal_raised-2.png" in second
    assert "skin-history-normal_raised-deformed-2.svg" in second
    assert (tmp_path / "skin-history-normal_raised.png").read_bytes() == kept
    assert "[" not in first, "no Python lists on stdout"


def test_an_unstable_history_is_refused_with_its_limit(tmp_path: Path):
    file = tmp_path / "history.json"
    file.write_text(json.dumps({"substeps": 1}))
    assert "above the stable limit of 0.513" in refused("history", "--settings", str(file))
