"""What a detection depends on besides the run file: the code and the parameters, as one digest.

A version number that is kept by hand does not distinguish two checkouts. Every file of code or of
weights that has a part in the way from a run file to its processed file is therefore hashed, as it
is when this module is imported, which is when the code itself is. Versions of libraries are not
part of it.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import rig
from rig.core.settings import fingerprint
from rig.detector.registered import ChosenDetector

CODE = (
    "detector/*.py",
    "detector/*.json",
    "processing/detection.py",
    "files/hdf5/*.py",
    "files/journal/*.py",
    "files/processed/*.py",
    "files/runfile/*.py",
)
"""Detector, network and all that reads and writes the files; names in the package `rig`."""


def _digest_of_code() -> str:
    root = Path(rig.__file__).parent
    hashed = hashlib.sha256()
    for path in sorted({path for pattern in CODE for path in root.glob(pattern)}):
        content = path.read_bytes()
        hashed.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode() + content)
    return hashed.hexdigest()


CODE_DIGEST = _digest_of_code()
"""SHA-256 of the names and contents of the files of `CODE`."""


def detection_digest(chosen: ChosenDetector) -> str:
    """Return the SHA-256 that two computers share if their code and parameters give the same
    processed file from the same run file."""
    return fingerprint(CODE_DIGEST, chosen.name, chosen.code_digest, chosen.settings)
