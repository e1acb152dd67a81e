"""What a reader of a stage sends over the real simulated wire: nothing that could change it."""

from __future__ import annotations

import contextlib
import re

import pytest
from role_contract.cases import CASES

from rig.testing import Case

STAGES = [case for case in CASES if "stage" in case.module().ROLES[0] or case.driver == "zaber-rst"]
READING = {
    "festo-cmmt": re.compile(rb"FC43|FC3 \d+"),
    "oriental-az": re.compile(rb"FC8 0|FC3 \d+"),
    "zaber-rst": re.compile(rb"get [a-z.]+|warnings"),
}
"""All that a driver's reader may send: identification, echoes, readings."""


@pytest.mark.parametrize("case", STAGES, ids=repr)
def test_a_reader_sends_only_what_reads(case: Case) -> None:
    module = case.module()
    with case.serve() as service:
        service.settings["timeout_s"] = 10.0
        before = list(service.bench.entries)
        settings = module.Settings.model_validate(service.settings)
        with contextlib.closing(module.open_reader(settings, service.clock)) as reader:
            for _ in range(3):
                reader.read()
        assert service.faults.heard, "the simulator has heard nothing"
        for request in service.faults.heard:
            assert READING[case.driver].fullmatch(request), request
        assert service.bench.entries == before


@pytest.mark.parametrize("case", [case for case in STAGES if case.driver != "zaber-rst"], ids=repr)
def test_a_reader_neither_sets_nor_acknowledges_the_drives_communication_timeout(
    case: Case,
) -> None:
    """After a run its time-out has stopped the drive, with a fault that is the next run's to
    acknowledge."""
    module = case.module()
    with case.serve() as service:
        service.settings |= {"timeout_s": 10.0, "communication_timeout_ms": 1000}
        settings = module.Settings.model_validate(service.settings)
        stage = module.connect(settings, service.clock)
        stage.home()
        stage.close()
        service.clock.sleep(3.0)
        for _ in range(2):
            with contextlib.closing(module.open_reader(settings, service.clock)) as reader:
                assert reader.timeout_s == settings.communication_timeout_ms * 1e-3
                status = reader.read()
            assert "communication time-out" in status.fault
            assert (status.moving, status.homed) == (False, True)
            service.clock.sleep(3.0)
