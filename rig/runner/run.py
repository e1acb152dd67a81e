"""What a procedure may use of the run it belongs to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rig.bench import Bench
from rig.clock import Clock
from rig.instruments import Record, Scaling
from rig.recording.recorder import Recorder
from rig.runner.arming import OFF_DEADLINE_S, Arming


class Run:
    """What `arm` and `take` may use of the run they belong to."""

    def __init__(
        self,
        settings: Any,
        bench: Bench,
        recorder: Recorder,
        streams: Mapping[str, int],
        elapsed_s: float,
    ):
        self.settings = settings
        self.bench = bench
        self.clock: Clock = bench.clock
        self.warnings: list[str] = []
        self._arming = Arming()
        self._recorder = recorder
        self._streams = streams
        self._scalings: dict[str, Scaling] = {}
        self._start_s = bench.clock.now() - elapsed_s

    def elapsed_s(self) -> float:
        """Bench time since the run's start in seconds; a resumed run goes on counting."""
        return self.clock.now() - self._start_s

    @property
    def arming(self) -> Arming:
        """What is switched on."""
        return self._arming

    def arm(self, name: str, off: Callable[[], None], deadline_s: float = OFF_DEADLINE_S) -> None:
        """Register how `name` is switched off; call it before switching it on."""
        self._arming.register(name, off, deadline_s)

    def emit(self, stream: str, record: Record) -> None:
        """Record raw samples of a stream; a changed scaling goes ahead of them."""
        index = self._streams[stream]
        scaling = record.scaling
        if self._scalings.get(stream) != scaling:
            self._recorder.put_stream(
                {
                    "stream": index,
                    "rate_Hz": scaling.rate_S_s,
                    "scale": scaling.volts_per_count,
                    "offset": scaling.offset_V,
                    "units": "V",
                    "delay_s": scaling.delay_s,
                    "range": scaling.range_V,
                }
            )
            self._scalings[stream] = scaling
        self._recorder.put_block(index, record.first_index, self.elapsed_s(), record.counts)

    def event(self, level: str, code: str, message: str) -> None:
        """Record that something happened; warnings are repeated at the end of the run."""
        if level == "warning" and message not in self.warnings:
            self.warnings.append(message)
        self._recorder.put_event(
            {
                "time": self.elapsed_s(),
                "level": level,
                "code": code,
                "message": message,
            }
        )

    def check_stop(self) -> None:
        """Let stop requests and failures of other threads end the run here; waits do it too."""
        self.clock.sleep(0)
