"""The program ``rig`` with the calls on its journal written down, for power cuts after the fact.

``python traced_rig.py TRACE ARGUMENT ...`` runs ``rig ARGUMENT ...``. After each call of `writev`
or `fdatasync` on a journal the kernel's answer is pickled to TRACE: the bytes that it took, or None
for a sync that has returned. The program's own code is untouched.
"""

import os
import pickle
import sys
from collections.abc import Sequence
from pathlib import Path

trace = Path(sys.argv.pop(1)).open("ab", buffering=0)  # noqa: SIM115 - open as long as the process
writev, fdatasync = os.writev, os.fdatasync


def is_journal(descriptor: int) -> bool:
    return Path(f"/proc/self/fd/{descriptor}").readlink().suffix == ".rigj"


def noting_writev(descriptor: int, buffers: Sequence[bytes]) -> int:
    taken = writev(descriptor, buffers)
    if is_journal(descriptor):
        pickle.dump(b"".join(buffers)[:taken], trace)
    return taken


def noting_fdatasync(descriptor: int) -> None:
    fdatasync(descriptor)
    if is_journal(descriptor):
        pickle.dump(None, trace)


os.writev, os.fdatasync = noting_writev, noting_fdatasync

from rig.cli import main  # noqa: E402

main()
