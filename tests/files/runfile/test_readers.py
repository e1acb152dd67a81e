"""What other programs make of a run file: xarray with h5netcdf, silx, and nexusformat, which NeXpy
reads with. Times are coordinates, dimensions have names, numbers have the units of physics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import recorded_run as run
import xarray
from recorded_skin import COUNTS_V, TRIALS, samples, write_skin

from rig.files.journal.layout import Column, Layout, Plot
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

SHOWN = ("data", "force", "position")
SIGNALS = {"data": "v_d", "force": "F_n", "position": "x"}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_skin(tmp_path_factory.mktemp("skin") / "a.rigj")


def opened(file: Path, group: str) -> xarray.Dataset:
    with xarray.open_dataset(file, group=f"entry/{group}", engine="h5netcdf") as data:
        return data.load()


@pytest.mark.parametrize("group", SHOWN)
def test_xarray_opens_what_is_shown_over_time(file: Path, group: str) -> None:
    data = opened(file, group)
    assert list(data.coords) == ["time"]
    assert data["time"].attrs["units"] == "s"
    signal = data[SIGNALS[group]]
    assert signal.dims == ("time",)
    assert signal.attrs["units"] == {"data": "V", "force": "N", "position": "mm"}[group]
    stream = {"data": "signals"}.get(group, group)
    np.testing.assert_array_equal(signal, samples(stream, 0)[:, 0])


def test_positions_are_at_the_times_of_their_ticks(file: Path) -> None:
    for number, trial in enumerate(TRIALS):
        data = opened(file, f"waveforms/{trial.replace('-', '_')}_position")
        np.testing.assert_array_equal(data["time"], samples("ticks", number)[:, 0])
        moved = data["x"].sel(time=0.25, method="nearest")
        assert moved.item() == pytest.approx(10 + 0.5 * 0.2, abs=0.006)


def test_raw_counts_are_volts_for_who_knows_the_cf_conventions(file: Path) -> None:
    data = opened(file, "waveforms/trial_002_strips")
    expected = samples("strips", 1)[:, 1] * COUNTS_V + 0.01
    np.testing.assert_allclose(data["strip_2"], expected, rtol=1e-6)
    assert data["strip_2"].attrs["units"] == "V"
    assert data["strip_2"].sel(time=0.1).item() == pytest.approx(expected[1000])
    with h5py.File(file) as opened_run:  # what is stored is what the converter sent
        stored = opened_run["entry/waveforms/trial_002_strips/strip_2"]
        np.testing.assert_array_equal(stored, samples("strips", 1)[:, 1])
        assert stored.attrs["scale"] == stored.attrs["scale_factor"] == COUNTS_V
        assert "scale_factor" not in opened_run["entry/force/F_n"].attrs
    with RunFile.open(file) as own:
        (wave,) = own.waveforms("trial-002", stream="strips")
        assert wave.units == "V"
        np.testing.assert_array_equal(wave.values("strip_2"), expected)


def test_every_axis_has_a_name(file: Path) -> None:
    nameless = []

    def check(name: str, item: object) -> None:
        if not isinstance(item, h5py.Dataset) or item.is_scale:
            return
        if not all(len(item.dims[k]) == 1 for k in range(item.ndim)):
            nameless.append(name)

    with h5py.File(file) as opened_run:
        for group in (*SHOWN, "waveforms", "events", "blocks"):
            opened_run["entry"][group].visititems(check)
    assert nameless == []


@pytest.mark.parametrize("group", [*SHOWN, "waveforms/trial_001_strips"])
def test_silx_and_nexusformat_plot_it(file: Path, group: str) -> None:
    from nexusformat.nexus import nxload
    from silx.io.nxdata import NXdata

    with h5py.File(file) as opened_run:
        shown = NXdata(opened_run[f"entry/{group}"])
        assert shown.is_valid, shown.issues
        assert shown.axes_dataset_names == ["time"]
    read = nxload(str(file))[f"entry/{group}"]
    assert [axis.nxname for axis in read.nxaxes] == ["time"]
    assert read.nxsignal.shape == read.nxaxes[0].shape
    assert read.nxaxes[0].units == "s"


def test_nexusformat_finds_nothing_wrong_in_it(file: Path) -> None:
    from nexusformat.nexus.validate import validate_file

    assert validate_file(str(file)) == (0, 0)
    assert verify(file) == []


@pytest.mark.thorough
def test_trials_without_end_share_axes_and_each_of_them_opens(tmp_path: Path) -> None:
    """One axis lists all who use it, in an attribute that ends at 64 KiB."""
    trials = tuple(f"trial-{number:03d}" for number in range(1, 71))
    file = write_skin(tmp_path / "many.rigj", trials)
    with h5py.File(file) as opened_run:
        groups = [
            opened_run[f"entry/waveforms/{trial.replace('-', '_')}_force"] for trial in trials
        ]
        axes = {h5py.h5o.get_info(group["time"].id).addr for group in groups}
    assert 1 < len(axes) < 5
    for trial in (trials[0], trials[59], trials[60], trials[-1]):
        data = opened(file, f"waveforms/{trial.replace('-', '_')}_force")
        assert data["F_n"].dims == ("time",)
        assert data["time"].size == 500


def test_the_same_journal_gives_the_same_bytes_with_its_scales(file: Path, tmp_path: Path) -> None:
    again = compile_run(file.with_suffix(".rigj"), tmp_path / file.name)
    assert again.read_bytes() == file.read_bytes()


def test_columns_of_readings_say_where_they_come_from(tmp_path: Path) -> None:
    columns = (
        Column("frequency", "Hz", "Frequency", origin="set"),
        Column("gain", "dB", "Gain"),
    )
    layout = replace(run.LAYOUT, columns=columns, plots=(Plot("data", "gain", ("frequency",)),))
    assert Layout.from_json(layout.to_json()) == layout
    assert "origin" not in layout.to_json()["columns"][1], "as older versions wrote it"
    file = compile_run(run.write_run(tmp_path / "a.rigj", layout=layout.to_json()))
    with h5py.File(file) as opened_file:
        points = opened_file["entry/points"]
        assert points["frequency"].attrs["origin"] == "set"
        assert "origin" not in points["gain"].attrs
