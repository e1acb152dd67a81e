"""What is said of a z that is not reached, before it is stopped again."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from procedures.pressed.approach.unload import unload
from rig.core.errors import InstrumentError, InstrumentTimeoutError
from rig.instruments.roles import LastSeen
from rig.run.ending import Ending

SILENT = InstrumentTimeoutError("stage_z", "stop", "no answer within 0.9 s", "check its cable")
SEEN = LastSeen(position_mm=12.5, seen_s=7.0, answered_s=8.0)


class Stage:
    """A stage that answers nothing from now on, and was at 12.5 mm 3 s ago."""

    def __init__(self, seen: LastSeen | Exception | None = SEEN):
        self._seen = seen
        self.stops = 0

    def stop(self) -> None:
        """Count; nothing is answered."""
        self.stops += 1
        raise SILENT

    def last_seen(self) -> LastSeen | None:
        """What was answered last."""
        if isinstance(self._seen, Exception):
            raise self._seen
        return self._seen


def unloaded(stage: Stage, force_N: float | None, lost: tuple[Any, ...]) -> tuple[list[str], str]:
    """What is said while z is stopped in vain at bench time 10, and the error of that."""
    said: list[str] = []
    ending = Ending(lambda level, code, text: None)
    ending.warn_at_once = lambda text: said.append(f"{stage.stops} stops: {text}")
    ending.lost, ending.silent = lost, frozenset(error.device for error in lost)
    run: Any = SimpleNamespace(
        bench=SimpleNamespace(stage_z=stage),
        clock=SimpleNamespace(now=lambda: 10.0),
        latest_force_N=lambda seconds: force_N,
        ending=ending,
        tripped=lambda: None,
    )
    with pytest.raises(InstrumentError) as caught:
        unload(run, "film", 5.0)
    return said, caught.value.one_line()


def test_a_z_whose_silence_ended_the_run_is_reported_before_it_is_stopped() -> None:
    said, error = unloaded(Stage(), 3.9, (SILENT,))
    known = (
        "stage_z has not answered for 2.0 s and was last seen at 12.500 mm, 3.0 s ago, and "
        "force_sensor reads 3.9 N"
    )
    assert said[0].startswith("0 stops: not safe yet: stage_z: stop: no answer within 0.9 s; ")
    assert known in said[0]
    assert known in error


def test_a_z_that_does_not_answer_its_stop_is_reported_before_the_next() -> None:
    said, _ = unloaded(Stage(), None, ())
    assert said[0].startswith("1 stops: ")
    assert "the force is not known" in said[0]


def test_a_z_that_falls_silent_on_the_way_up_is_reported_before_anything_else_is_asked() -> None:
    """Found by an attack: it was reported 2.7 s after its last answer, when its fault had been
    asked for in vain, and it could not be stopped."""

    class Silent(Stage):
        def stop(self) -> None:
            """Answer the first."""
            self.stops += 1
            if self.stops > 1:
                raise SILENT

        def position_mm(self) -> float:
            """Fall silent."""
            raise SILENT

        def acknowledge_timeout(self) -> bool:
            """Stay silent, for longer than there is time."""
            self.stops += 100
            raise SILENT

    said, _ = unloaded(Silent(), 3.9, ())
    assert said[0].startswith("1 stops: ")


@pytest.mark.parametrize("seen", [None, RuntimeError("a defect of another package's driver")])
def test_a_driver_that_cannot_say_where_it_was_is_stopped_all_the_same(
    seen: Exception | None,
) -> None:
    stage = Stage(seen)
    said, _ = unloaded(stage, 3.9, (SILENT,))
    assert stage.stops == 2
    assert "its position is not known, and force_sensor reads 3.9 N" in said[0]
