"""Compiles the contact kernel and the detector kernel once, before any test needs them.

numba keeps the compiled code beside the sources, in ``__pycache__``. Tests, their workers and the
commands that they start all read it from there; without it each of them would compile the same code
at the same time, for one to two minutes.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
SOURCES = ("rig/physics/contact/kernel.py", "rig/detector/kernel.py")
STAMP = Path(__file__).parent / "__pycache__" / "kernels-compiled"


def ensure_compiled() -> None:
    """Compile both kernels, unless that has been done since they, numba or Python changed.

    A second test run that starts meanwhile waits. Raises CalledProcessError where a kernel does not
    compile; what the compiler said is on stderr by then.
    """
    STAMP.parent.mkdir(exist_ok=True)
    with STAMP.open("a+") as stamp:
        fcntl.flock(stamp, fcntl.LOCK_EX)
        stamp.seek(0)
        if stamp.read() == _made_from():
            return
        print("compiling the contact and the detector kernel: 1 to 2 minutes", file=sys.stderr)
        subprocess.run([sys.executable, __file__], cwd=REPOSITORY, check=True)
        stamp.seek(0)
        stamp.truncate()
        stamp.write(_made_from())


def _made_from() -> str:
    """Return a hash of what numba looks at before it takes compiled code from its cache, and of
    whether there is any."""
    import importlib.metadata

    seen: list[object] = [sys.version, importlib.metadata.version("numba")]
    for source in (REPOSITORY / name for name in SOURCES):
        state = source.stat()
        cache = Path(os.environ.get("NUMBA_CACHE_DIR", source.parent / "__pycache__"))
        seen += [state.st_mtime_ns, state.st_size, cache, any(cache.rglob("kernel.advance-*.nbc"))]
    return hashlib.sha256(repr(seen).encode()).hexdigest()


def call_kernels() -> None:
    """Call both kernels, the contact with a plate and with a roller, the detector with a network
    and without."""
    import numpy as np

    from rig.core.cache import NoCache
    from rig.detector.detector import IncipientSlipDetector
    from rig.detector.settings import named_detectors
    from rig.physics.contact.settings import ContactSettings, Cylinder, Plate
    from rig.physics.contact.stepper import ContactStepper
    from rig.physics.skin.condensed import build_skin
    from rig.physics.skin.settings import SkinSettings

    skin = build_skin(SkinSettings(ridges=3, elements_per_ridge=4), NoCache())
    for body in (Plate(), Cylinder()):
        stepper = ContactStepper(skin, ContactSettings(), body)
        stepper.advance(np.linspace(0.01, 0.5, 20), 0.0)
    for settings in named_detectors().values():
        IncipientSlipDetector(settings, 1000.0).add(np.zeros((10, 2)))


if __name__ == "__main__":
    sys.path.insert(0, str(REPOSITORY))
    call_kernels()
