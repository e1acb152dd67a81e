"""pyvisa-py, whose search for a USB library waits until something on USB is opened.

Importing it looks for libusb. Where a compiler is installed and that library is not, the search has
the compiler and the linker try a dozen names, which takes longer than all the rest of the import.
"""

from __future__ import annotations

import contextlib
import sys
from importlib import import_module

USB_SESSIONS = "pyvisa_py.usb"


def import_visa(resource: str = "") -> None:
    """Import what opens a resource: one on USB, or any other."""
    if resource.upper().startswith("USB"):
        if sys.modules.get(USB_SESSIONS, ...) is None:
            del sys.modules[USB_SESSIONS]
        import_module("pyvisa_py.highlevel")
        with contextlib.suppress(Exception):  # as pyvisa-py does: opening tells what is missing
            import_module(USB_SESSIONS)
    elif "pyvisa_py.highlevel" not in sys.modules:
        sys.modules.setdefault(USB_SESSIONS, None)  # type: ignore[arg-type]
        import_module("pyvisa_py.highlevel")
