"""The search for a USB library waits until something on USB is opened."""

from __future__ import annotations

import subprocess
import sys

STEPS = """
import sys
from rig.instruments.visa_library import import_visa
for resource in {!r}:
    import_visa(resource)
    print("tcpip" in str(sys.modules.get("pyvisa_py.tcpip")), "usb.core" in sys.modules)
"""
USB, LAN = "USB0::0x0957::0x1518::TW1::INSTR", "TCPIP::127.0.0.1::hislip0,1::INSTR"


def imported(*resources: str) -> list[str]:
    ended = subprocess.run(
        [sys.executable, "-c", STEPS.format(resources)], capture_output=True, text=True, check=True
    )
    return ended.stdout.splitlines()


def test_nothing_looks_for_usb_unless_a_resource_is_on_it() -> None:
    assert imported("", LAN) == ["True False", "True False"]


def test_it_is_looked_for_whatever_was_opened_before() -> None:
    assert imported(LAN, USB, USB) == ["True False", "True True", "True True"]
    assert imported(USB, LAN) == ["True True", "True True"]
