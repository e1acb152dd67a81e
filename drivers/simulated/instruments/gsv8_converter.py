"""Converter of the GSV-8: bridges of a three-axis force sensor, and the noise on every channel.

It runs at 48 kS/s; a frame carries the mean of the conversions since the frame before it, whose
-3 dB point is 0.443 of the frame rate (the maker states about 0.4). At most 48 conversions a frame
are computed, evenly spread, so that slow rates stay cheap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from drivers.simulated.instruments.disturbed_converter import DisturbedConverter
from drivers.simulated.ports import ForcePort

CHANNELS = 8
CONVERSIONS_PER_S = 48_000
CONVERSIONS_COMPUTED = 48
"""Maximum number of conversions of one frame that are computed."""
INPUT_RANGE_MV_V = 3.5
OVERRANGE = 1.05
"""The converter's end, in input ranges."""
NOISE_MV_V = 2e-5
"""Standard deviation of a value at 1000 frames/s, as the root of the rate (UNCONFIRMED)."""
NOISE_CHUNK = 256
BRIDGE_RANGES_MV_V = (INPUT_RANGE_MV_V, 7.0, 14.0)
"""Input range by input type, the smallest first: bridge at 5, 2.5 and 1.25 V (UNCONFIRMED beyond
the first)."""


def input_range(input_type: int) -> float:
    """Return the input range in mV/V of an input type, 0 to 2. Raises IndexError for one above."""
    return BRIDGE_RANGES_MV_V[input_type]


@cache
def _input_range_of_each(input_types: tuple[int, ...]) -> npt.NDArray[np.float64]:
    return np.array([input_range(kind) for kind in input_types])


@dataclass(frozen=True)
class Sensor:
    """A three-axis sensor: force in N is `matrix` times the bridges' mV/V after `zero_mV_V`.

    The default is a K3D40 of 50 N: a calibrated one of 10 N, scaled (UNCONFIRMED).
    """

    matrix: tuple[tuple[float, float, float], ...] = (
        (83.198, 0.354, -0.552),
        (0.375, 79.864, 0.828),
        (1.516, 0.452, 83.675),
    )
    zero_mV_V: tuple[float, float, float] = (0.012, -0.007, 0.021)

    def bridges(self, force_N: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the outputs of the three bridges in mV/V under forces (n, 3)."""
        inverse, zero, *_ = _inverse(self.matrix, self.zero_mV_V)
        return np.asarray(force_N @ inverse.T + zero)

    def largest_bridge(self, force_N: float) -> float:
        """Return a bound in mV/V of all bridges' outputs while no component of the force exceeds
        `force_N`."""
        _, _, most_mV_V_N, most_zero_mV_V = _inverse(self.matrix, self.zero_mV_V)
        return most_mV_V_N * force_N + most_zero_mV_V


@cache
def _inverse(
    matrix: tuple[tuple[float, ...], ...], zero: tuple[float, ...]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], float, float]:
    """Return the inverse and the zero; by how much a bridge's output can rise with the largest
    component of the force, in mV/V per N; and the largest zero."""
    inverse, at = np.linalg.inv(np.array(matrix)), np.array(zero)
    return inverse, at, float(np.abs(inverse).sum(axis=1).max()), float(np.abs(at).max())


class BridgeConverter:
    """Converters of all channels: bridges on channels 1 to 3, open inputs on the others."""

    def __init__(self, port: ForcePort, sensor: Sensor):
        self.sensor = sensor
        self._port = port
        self._divisor = 1
        self._back_s = np.zeros(1)
        """Time from each computed conversion to the end of its frame, in s."""
        self._noise_key: tuple[int, ...] | None = None
        self._noise_at = 0
        self._noise: dict[int, npt.NDArray[np.float64]] = {}
        self._disturbed = DisturbedConverter(CHANNELS, OVERRANGE)
        """Disturbed values of the converters, in input ranges."""

    def begin(self, divisor: int) -> None:
        """Begin to average this many conversions a frame."""
        self._divisor = divisor
        count = min(divisor, CONVERSIONS_COMPUTED)
        self._back_s = divisor / CONVERSIONS_PER_S * np.arange(count)[::-1] / count

    def disturb(
        self,
        kind: str,
        begin_s: float,
        channel: int,
        force_N: float,
        input_types: tuple[int, ...],
        **keys: float,
    ) -> None:
        """Take a disturbance from a World time on; `force_N` is what a wrong value adds along the
        axis of that channel, from 0."""
        along = np.zeros(3)
        along[channel] = force_N
        full = _input_range_of_each(input_types)
        added = np.zeros(CHANNELS)
        added[:3] = (self.sensor.bridges(along) - self.sensor.zero_mV_V) / full[:3]
        self._disturbed.add(kind, begin_s, channel=channel, added=added, **keys)

    def input_ranges(
        self, ends_s: npt.NDArray[np.float64], input_types: tuple[int, ...]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """Return each channel's mean over the frame period that ends at each instant, in input
        ranges, and whether the converter stood at its end within it: both (n, 8)."""
        count, per_frame = len(ends_s), len(self._back_s)
        times = np.maximum(ends_s[:, None] - self._back_s, 0.0)
        force = self._port.force_N(times.ravel()).reshape(count, per_frame, 3)
        full = _input_range_of_each(input_types)
        saturated = np.zeros((count, CHANNELS), bool)
        ranges = self._noise_of(count) / full
        largest_mV_V = self.sensor.largest_bridge(float(np.abs(force).max()))
        if largest_mV_V < OVERRANGE * INPUT_RANGE_MV_V:
            by_conversion = force.swapaxes(0, 1).reshape(per_frame, -1)
            mean = np.add.reduce(by_conversion).reshape(count, 3) / per_frame
            ranges[:, :3] += self.sensor.bridges(mean) / full[:3]  # of the mean: it is linear
        else:
            converted = self.sensor.bridges(force.reshape(-1, 3)).reshape(force.shape) / full[:3]
            saturated[:, :3] = (np.abs(converted) >= OVERRANGE).any(axis=1)
            ranges[:, :3] += np.clip(converted, -OVERRANGE, OVERRANGE).mean(axis=1)
        np.minimum(np.maximum(ranges, -OVERRANGE, out=ranges), OVERRANGE, out=ranges)
        self._disturbed.apply(ends_s, ranges, saturated)
        return ranges, saturated

    def _noise_of(self, count: int) -> npt.NDArray[np.float64]:
        """Return the noise of the next frames in mV/V, (n, 8): by key and by number of frames since
        it came, made in whole chunks, so that neither batches nor earlier points matter."""
        if self._noise_key != (key := self._port.noise_key):
            self._noise_key, self._noise_at = key, 0
            self._noise.clear()
        first, self._noise_at = self._noise_at, self._noise_at + count
        chunks = range(first // NOISE_CHUNK, (self._noise_at - 1) // NOISE_CHUNK + 1)
        drawn = [self._noise_chunk(chunk) for chunk in chunks]
        begin = first - chunks[0] * NOISE_CHUNK
        rms = NOISE_MV_V * math.sqrt(CONVERSIONS_PER_S / self._divisor / 1000)
        noise = drawn[0] if len(drawn) == 1 else np.concatenate(drawn)
        return rms * noise[begin : begin + count]

    def _noise_chunk(self, chunk: int) -> npt.NDArray[np.float64]:
        if chunk not in self._noise:
            assert self._noise_key is not None
            source = np.random.default_rng([*self._noise_key, chunk])
            self._noise = {chunk: source.standard_normal((NOISE_CHUNK, CHANNELS))}
        return self._noise[chunk]
