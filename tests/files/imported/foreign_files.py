"""Recordings as other programs write them."""

from __future__ import annotations

import io
from typing import Any

import h5py
import numpy as np
from scipy.io import savemat

MARK = {"tab": "\t", "semicolon": ";", "comma": ",", "space": " "}
RATE_Hz = 1000.0


def signals(rows: int = 40) -> dict[str, np.ndarray]:
    """Times and two strips, with every digit that a double has."""
    t = np.arange(rows) / RATE_Hz
    return {"time": t, "v_1": np.sin(40 * t) / 3, "v_2": -np.cos(31 * t) / 7 * 1e-3}


def cell(value: float, decimal: str = "point") -> str:
    """A number as a file has it, to its last digit."""
    text = repr(float(value))
    return text.replace(".", ",") if decimal == "comma" else text


def text(
    columns: dict[str, np.ndarray],
    delimiter: str = "comma",
    decimal: str = "point",
    header: str | None = None,
) -> str:
    """The columns as text; `header` stands above them as it is."""
    rows = zip(*columns.values(), strict=True)
    lines = [MARK[delimiter].join(cell(v, decimal) for v in row) for row in rows]
    return "\n".join([*([] if header is None else [header]), *lines]) + "\n"


def lvm(
    columns: dict[str, np.ndarray],
    separator: str = "Tab",
    decimal: str = ".",
    x_columns: str = "One",
    x_digits: int = 6,
    **segment: str,
) -> str:
    """The columns after the first, over it, as LabVIEW writes them; `segment` changes its header,
    a cell a channel."""
    mark = {"Tab": "\t", "Comma": ",", "Semicolon": ";"}[separator]
    names = list(columns)[1:]
    fields = {
        "Samples": [str(len(columns[names[0]]))] * len(names),
        "Date": ["2014/09/10"] * len(names),
        "Y_Unit_Label": ["Volts"] * len(names),
        "X_Dimension": ["Time"] * len(names),
        "X0": ["0.0000000000000000E+0"] * len(names),
        "Delta_X": ["0.001000"] * len(names),
    } | {name: cells.split("|") for name, cells in segment.items()}
    lines = [
        "LabVIEW Measurement\t".replace("\t", mark),
        f"Writer_Version{mark}2",
        f"Separator{mark}{separator}",
        f"Decimal_Separator{mark}{decimal}",
        f"Multi_Headings{mark}No",
        f"X_Columns{mark}{x_columns}",
        f"Time_Pref{mark}Absolute",
        f"Operator{mark}somebody",
        "***End_of_Header***" + mark,
        mark,
        mark.join(["Channels", str(len(names)), ""]),
        *(mark.join([name, *cells, ""]) for name, cells in fields.items() if cells != ["-"]),
        "***End_of_Header***" + 2 * mark,
    ]
    if x_columns == "Multi":
        heads = [part for name in names for part in ("X_Value", name)]
    else:
        heads = ["X_Value", *names]
    lines.append(mark.join([*heads, "Comment"]))
    sign = "comma" if decimal == "," else "point"
    for row, values in enumerate(zip(*(columns[name] for name in names), strict=True)):
        x = f"{columns['time'][row]:.{x_digits}f}".replace(".", decimal)
        cells = [cell(value, sign) for value in values]
        if x_columns == "Multi":
            cells = [part for value in cells for part in (x, value)]
        else:
            cells = ["" if x_columns == "No" else x, *cells]
        lines.append(mark.join([*cells, "pressed"] if row == 0 else cells))
    return "\r\n".join(lines) + "\r\n"


def matlab_5(compressed: bool = False, **variables: Any) -> bytes:
    """Variables as ``save -v6`` or ``-v7`` keeps them."""
    file = io.BytesIO()
    savemat(file, variables, do_compression=compressed)
    return file.getvalue()


def matlab_73(**variables: np.ndarray) -> bytes:
    """Variables as ``save -v7.3`` keeps them: HDF5 behind 512 bytes, columns first."""
    file = io.BytesIO()
    with h5py.File(file, "w", userblock_size=512) as opened:
        for name, value in variables.items():
            array = np.atleast_2d(value)
            made = opened.create_dataset(name, data=array.T, compression="gzip")
            kind = {"float64": "double", "float32": "single"}.get(str(array.dtype))
            made.attrs["MATLAB_class"] = np.bytes_(kind or str(array.dtype))
        struct = opened.create_group("info")
        struct.attrs["MATLAB_class"] = np.bytes_("struct")
    content = bytearray(file.getvalue())
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Sun Nov 22 2026"
    content[: len(head)] = head
    return bytes(content)
