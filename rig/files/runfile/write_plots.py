"""The plots of a run file: groups of columns that viewers draw at the first click."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from rig.files.hdf5.nexus import array_field, group, share_scale, text_field
from rig.files.journal.layout import Layout, Plot
from rig.files.runfile.table import PointTable

if TYPE_CHECKING:
    import h5py


def write_plot(
    entry: h5py.Group, plot: Plot, layout: Layout, table: PointTable, title: str
) -> h5py.Group:
    """Write an NXdata group with the plot's columns of the table, sorted by the plot's axes.

    The columns are copies, not links to ``points``: a dataset that is linked into several groups
    can carry the dimension scale of one of them only. Returns the group.
    """
    data = group(entry, plot.group, "NXdata")
    data.attrs["signal"] = plot.signal
    data.attrs["axes"] = [plot.axes[0]]
    for axis in plot.axes:
        data.attrs[f"{axis}_indices"] = [0]
    if plot.auxiliary:
        data.attrs["auxiliary_signals"] = list(plot.auxiliary)
    if plot.log_axes:
        data.attrs["SILX_style"] = silx_style(plot)
    text_field(data, "title", title)
    order = table.order(plot.axes)
    for name, source in plot.sources().items():
        column = layout.column(source)
        units = column.units or "1"
        array_field(data, name, table.numbers(source)[order], units, column.long_name)
    share_scale(data, plot.axes[0])
    return data


def silx_style(plot: Plot) -> str:
    """Return the scales of a plot's axes as JSON, in h5web's and in silx's spelling."""
    axes = ["log" if plot.axes[0] in plot.log_axes else "linear"]
    style: dict[str, object] = {"axes_scale_type": axes, "axes_scale_types": axes}
    if plot.signal in plot.log_axes:
        style["signal_scale_type"] = "log"
    return json.dumps(style)
