"""What the contract kit leaves behind."""

from __future__ import annotations

from dataclasses import replace

import pytest

from drivers.oriental_az.link import AzLine
from rig.core.errors import InstrumentError
from rig.testing import checks
from rig.testing.roles import ROLES
from rig.testing.script import Step

from .cases import LineAxisCase


def test_an_instrument_whose_step_fails_twice_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(instrument: object, service: object) -> None:
        raise InstrumentError("stage_z", "move", "does not answer", "look at it")

    failing = replace(ROLES["stage_z"], script=(Step("a step that fails", fail),))
    monkeypatch.setitem(ROLES, "stage_z", failing)
    case = LineAxisCase()
    failures: list[InstrumentError] = []
    with checks.undisturbed(case) as service:
        with pytest.raises(InstrumentError, match="does not answer"):
            checks.experiment_with_retries(case, service, failures)
        assert len(failures) == 1
        assert service.settings["port"] not in AzLine._open, "its line was left open"
