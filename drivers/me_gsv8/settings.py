"""The settings of a GSV-8 and its sensor in a bench file. Plain data."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from rig.core.settings import Address, Settings, Wiring

INPUT_RANGE_MV_V = 3.5
"""Input range of the factory setting; with a user scale as large, floats are in mV/V."""
Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


class MeGsv8Settings(Settings):
    """Settings of the amplifier and its sensor."""

    driver: Literal["me-gsv8"] = "me-gsv8"
    port: Address[str] = Field(min_length=1)
    """Serial port, for example /dev/ttyACM0 or COM5."""
    baudrate: int = Field(default=230_400, ge=19_200, le=3_500_000)
    """Bits per second; without meaning over USB."""
    timeout_s: Wiring[float] = Field(default=0.5, gt=0, le=60)
    """Longest wait for an answer."""
    rate_S_s: float = Field(default=1000.0, ge=1, le=12_000)
    """Frames per second that `connect` sets; `start` may set another rate."""
    nominal_force_N: float = Field(default=50.0, gt=0)
    """The sensor's nominal force on each axis."""
    rated_output_mV_V: float = Field(default=0.6, gt=0)
    """Bridge output at the nominal force; 0.6 is typical of a K3D40 [unconfirmed for 50 N]."""
    matrix_N_mV_V: Wiring[Matrix | None] = None
    """The calibration sheet's matrix, force in N by bridge output in mV/V; without one, nominal
    force by rated output on the diagonal, which neglects 0.4 to 2 % of crosstalk."""
    max_force_N: float | None = Field(default=None, gt=0)
    """Largest force along any axis; the nominal force if it is not given."""
    user_scale_mV_V: float = Field(default=INPUT_RANGE_MV_V, gt=0)
    """The amplifier's user scale and the input range that it stands for."""

    @model_validator(mode="after")
    def _plausible(self) -> MeGsv8Settings:
        if abs(np.linalg.det(np.array(self.matrix))) < 1e-9:
            raise ValueError("matrix_N_mV_V cannot be inverted: two axes would be one")
        if self.max_force_N is not None and self.max_force_N > 1.5 * self.nominal_force_N:
            raise ValueError(
                f"max_force_N = {self.max_force_N:g} N is beyond 1.5 times nominal_force_N = "
                f"{self.nominal_force_N:g} N"
            )
        return self

    @property
    def matrix(self) -> Matrix:
        """Force in N by bridge output in mV/V."""
        if self.matrix_N_mV_V is not None:
            return self.matrix_N_mV_V
        gain = self.nominal_force_N / self.rated_output_mV_V
        return ((gain, 0.0, 0.0), (0.0, gain, 0.0), (0.0, 0.0, gain))

    @property
    def force_limit_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        """The largest force allowed along an axis, in N."""
        return self.max_force_N if self.max_force_N is not None else self.nominal_force_N
