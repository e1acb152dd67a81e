"""The variables of a MATLAB file or a NumPy npz, read in a child process.

SciPy has crashed on damaged files of version 5, and HDF5 may loop for ever on one of version 7.3;
nothing in their own process can interrupt either. ``python -m rig.files.imported.matlab_variables
[NAME...]`` reads the file's bytes from stdin and answers on stdout: without names the list of
variables as JSON, with names their arrays as NumPy's npz.
"""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rig.core.child import ChildError, run_module
from rig.core.errors import shortened
from rig.files.errors import ForeignFileError
from rig.files.hdf5.safe_reading import refuse_links, whole

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAGIC_5, MAGIC_73 = b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"
MAGIC_NPZ = b"PK\x03\x04"
"""A zip archive, which a NumPy npz is."""

PATIENCE_S = 60.0
"""Time allowed for a small file; a large one gets more by BYTES_PER_S."""
BYTES_PER_S = 1e6
"""Slower than any computer that runs this reads a file."""

Variables = dict[str, tuple[str, tuple[int, ...]]]
"""Class, in MATLAB's word, and shape of each variable; an empty shape if it is not an array."""


def variables_of(content: bytes, name: str) -> Variables:
    """Return class and shape of every variable. Raises ForeignFileError if the file cannot be
    read."""
    listed = json.loads(_ask_child(content, name, ()))
    return {variable: (kind, tuple(shape)) for variable, (kind, shape) in listed.items()}


def arrays_of(content: bytes, name: str, wanted: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return the arrays of the variables `wanted`. Raises ForeignFileError if the file cannot be
    read."""
    import numpy as np

    with np.load(io.BytesIO(_ask_child(content, name, wanted)), allow_pickle=False) as arrays:
        return {variable: arrays[f"{number}"] for number, variable in enumerate(wanted)}


def _ask_child(content: bytes, name: str, wanted: Sequence[str]) -> bytes:
    timeout_s = PATIENCE_S + len(content) / BYTES_PER_S
    try:
        return run_module(__name__, wanted, given=content, timeout_s=timeout_s)
    except ChildError as error:
        kind = "NumPy npz" if content.startswith(MAGIC_NPZ) else "MATLAB file"
        reason = f"not a readable {kind}: {shortened(error.reason, 200)}"
        raise ForeignFileError(name, reason, "it is damaged: save it again") from None


def _version_5(content: bytes, wanted: list[str]) -> dict[str, Any]:
    from scipy.io import loadmat, whosmat

    file: Any = io.BytesIO(content)  # SciPy's types know names alone
    if not wanted:
        return {variable: (kind, shape) for variable, shape, kind in whosmat(file)}
    loaded = loadmat(file, variable_names=wanted, verify_compressed_data_integrity=True)
    return {variable: loaded[variable] for variable in wanted}


def _version_73(content: bytes, wanted: list[str]) -> dict[str, Any]:
    import h5py

    with h5py.File(io.BytesIO(content), "r") as file:
        refuse_links(file)
        if wanted:  # MATLAB stores columns first
            return {variable: whole(file[variable]).T for variable in wanted}
        names = [variable for variable in file if not variable.startswith("#")]  # cells' contents
        return {variable: _described(file[variable], h5py) for variable in names}


def _numpy(content: bytes, wanted: list[str]) -> dict[str, Any]:
    """Return the arrays of a NumPy npz, vectors as one column; pickled objects are never loaded."""
    import numpy as np

    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        if wanted:
            return {variable: _as_matrix(arrays[variable]) for variable in wanted}
        found: dict[str, Any] = {}
        for variable in arrays.files:
            try:
                array = _as_matrix(arrays[variable])
            except ValueError:  # of objects
                found[variable] = ("object", ())
            else:
                found[variable] = (
                    _IN_MATLABS_WORD.get(array.dtype.name, array.dtype.name),
                    array.shape,
                )
        return found


_IN_MATLABS_WORD = {
    "float128": "double",
    "float64": "double",
    "float32": "single",
    "float16": "single",
    "bool": "logical",
}
"""MATLAB's class of what NumPy calls otherwise, or of the closest that holds its values."""


def _as_matrix(array: Any) -> Any:
    return array.reshape(-1, 1) if array.ndim == 1 else array


def _described(item: Any, h5py: Any) -> tuple[str, tuple[int, ...]]:
    kind = item.attrs.get("MATLAB_class", b"group")
    kind = kind.decode() if isinstance(kind, bytes) else str(kind)
    if not isinstance(item, h5py.Dataset):
        return ("sparse" if "MATLAB_sparse" in item.attrs else kind), ()
    shape = (0, 0) if "MATLAB_empty" in item.attrs else tuple(reversed(item.shape))
    return kind, shape


def main() -> None:
    """Answer one request on stdout; exit with a line on stderr for a file that cannot be read."""
    content, wanted = sys.stdin.buffer.read(), sys.argv[1:]
    read = _version_73 if content.startswith(MAGIC_73) else _version_5
    if content.startswith(MAGIC_NPZ):
        read = _numpy
    try:
        found = read(content, wanted)
        answer = _npz(found.values()) if wanted else json.dumps(found).encode()
    except Exception as error:  # noqa: BLE001 - the readers raise anything for a damaged file
        sys.exit(" ".join(str(error).split()) or type(error).__name__)
    sys.stdout.buffer.write(answer)


def _npz(arrays: Any) -> bytes:
    import numpy as np

    plain = [np.asarray(array) for array in arrays]
    if any(array.dtype.hasobject for array in plain):
        raise ValueError("a variable is not an array of numbers")
    file = io.BytesIO()
    named: dict[str, Any] = {str(number): array for number, array in enumerate(plain)}
    np.savez(file, **named)
    return file.getvalue()


if __name__ == "__main__":
    main()
