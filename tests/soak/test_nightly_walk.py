"""The nightly tier: each kind of fault of the wire at every request of a trial, link by link.

A walk begins at the first request of one device and ends with the first that the trial does not
make any more. All of them take some thousand processor minutes: choose with ``-k``, or walk only
every n-th request with `RIG_EVERY=n`.
"""

from __future__ import annotations

import itertools
import os
import shutil
from pathlib import Path

import pytest
from forked_rig import server

from drivers.simulated.faults.plan import devices_by_fault

from .attacks import KINDS, LINKS, OPTIONS, left_pressed
from .invariants import breaches, left_unsaid
from .running import run
from .trials import ON_A_LINE, STAGES, Trial, world_of

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(0)]

EVERY = int(os.environ.get("RIG_EVERY", "1"))
WALKS = [
    (procedure, stages, device, kind)
    for procedure, stages in itertools.product(LINKS, STAGES)
    for device in LINKS[procedure]
    for kind in KINDS
    if device in devices_by_fault(ON_A_LINE[stages])[kind]
]


@pytest.mark.parametrize(("procedure", "stages", "device", "kind"), WALKS)
def test_a_fault_at_any_request_breaks_nothing(
    procedure: str, stages: str, device: str, kind: str, tmp_path: Path
) -> None:
    arguments = (procedure, *OPTIONS[procedure], "--stages", stages)
    broken: dict[int, list[str]] = {}
    for at in itertools.count(1, EVERY):
        fault = {"device": device, "kind": kind, "at": at}
        trial = Trial(at, arguments, world_of(procedure, [fault]), (fault,))
        ran = run(server(), trial, tmp_path / str(at))
        if not ran.faults_met:
            break
        if found := [*breaches(ran), *left_pressed(ran), *left_unsaid(ran)]:
            broken[at] = found
        else:
            shutil.rmtree(ran.folder)
    assert at > 1, "the device was asked nothing"
    assert broken == {}
