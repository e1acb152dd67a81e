"""The project's own NeXus application definitions, one NXDL file each."""

from __future__ import annotations

from pathlib import Path


def definition_path(name: str) -> Path:
    """Return the NXDL file of a definition such as ``NXrig_sweep``. Raises FileNotFoundError if
    there is none.
    """
    path = Path(__file__).with_name(f"{name}.nxdl.xml")
    if not path.is_file():
        raise FileNotFoundError(f"no NXDL file for {name}")
    return path
