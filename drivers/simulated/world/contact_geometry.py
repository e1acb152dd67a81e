"""The geometry of skin and object: approach, position and rotation from the stages' positions.

The skin hangs on the x-z stage, its middle above the object where x stands at `centre_mm`. A plate
lies still. A head is carried by the rotary stage: its centre lies the head's radius below its top,
and the axis of rotation where pure rolling wants it, at the height of the top, or `axis_offset_mm`
above that. A turn by ϕ from upright swings the centre sideways by (R + h) sin ϕ and up by (R + h)
(1 - cos ϕ), while R ϕ is what pure rolling takes: an offset h shears the skin by h ϕ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from pydantic import Field

from rig.core.settings import Settings
from rig.physics.contact.settings import Cylinder, Object, Plate, Sphere

Reals = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Where = Callable[[Times], Reals]
"""Function that returns positions of a carriage in mm, or of a rotary stage in deg, at ascending
World times in us."""
CLEARANCE_TOLERANCE_mm = 1e-6
"""Distance in mm from which there is no contact, despite the rounding of positions."""


class Carriage(Protocol):
    """The stage that carries the skin along one axis."""

    def positions_mm(self, times_us: Times) -> Reals:
        """Return its positions in mm, (n,), at ascending World times (n,)."""
        ...

    def highest_mm(self, begin_us: int, end_us: int) -> float:
        """Return the largest of its positions between two World times."""
        ...


class HeadSettings(Settings):
    """The object with a head that the rotary stage carries."""

    body: Object = Cylinder()
    """Shape of the head: a roller as wide as the skin, or the paper's sphere, whose slices take
    five times the computing time, which is too much for real time on a slow computer."""
    centre_mm: float = 10.0
    """Position of the x stage at which the middle of the skin is above it."""
    upright_deg: float = 15.0
    """Angle of the rotary stage at which it stands upright."""
    axis_offset_mm: float = Field(default=0.3, ge=-20, le=20)
    """Distance of the rotary axis above its place for pure rolling (assumed)."""


@dataclass(frozen=True)
class ContactGeometry:
    """Skin and object at k instants; arrays (k,)."""

    approach_mm: Reals
    """Distance of the object beyond the height at which it touches the undeformed skin."""
    x_mm: Reals
    """The object's place as the skin sees it: of a head, its centre's."""
    turned_rad: Reals
    """Angle of the object; a positive one rolls towards +x."""

    def __getitem__(self, part: slice) -> ContactGeometry:
        return ContactGeometry(self.approach_mm[part], self.x_mm[part], self.turned_rad[part])


class Below(Protocol):
    """The object below the skin."""

    @property
    def body(self) -> Plate | Cylinder | Sphere:
        """Shape of the object."""
        ...

    def apart(self, begin_us: int, end_us: int) -> bool:
        """Return whether it surely does not meet the undeformed skin between two World times: where
        that is quickly known."""
        ...

    def at(self, times_us: Times) -> ContactGeometry:
        """Return its contact with the skin at ascending World times."""
        ...


@dataclass(frozen=True)
class PlateBelow:
    """A plate that lies on the force sensor."""

    contact_mm: float
    """Position of z at which the skin just touches it."""
    z: Carriage
    x: Carriage

    @property
    def body(self) -> Plate:
        """See `Below`."""
        return Plate()

    def apart(self, begin_us: int, end_us: int) -> bool:
        """See `Below`."""
        return self.z.highest_mm(begin_us, end_us) < self.contact_mm - CLEARANCE_TOLERANCE_mm

    def at(self, times_us: Times) -> ContactGeometry:
        """See `Below`."""
        z_mm = self.z.positions_mm(times_us)
        x_mm = self.x.positions_mm(times_us)
        return ContactGeometry(z_mm - self.contact_mm, x_mm, np.zeros(z_mm.size))


@dataclass(frozen=True)
class HeadBelow:
    """A head on the rotary stage, which stands on the force sensor."""

    settings: HeadSettings
    contact_mm: float
    """Position of z at which the skin just touches it, while it stands upright."""
    z: Carriage
    x: Carriage
    angle_deg: Where

    @property
    def body(self) -> Plate | Cylinder | Sphere:
        """See `Below`."""
        return self.settings.body

    def apart(self, begin_us: int, end_us: int) -> bool:
        """See `Below`: here for a head that turns."""
        return False

    def at(self, times_us: Times) -> ContactGeometry:
        """See `Below`."""
        body, head = self.settings.body, self.settings
        assert not isinstance(body, Plate), "a plate does not roll"
        arm_mm = body.radius_mm + head.axis_offset_mm
        z_mm, x_mm = self.z.positions_mm(times_us), self.x.positions_mm(times_us)
        turned = np.radians(self.angle_deg(times_us) - head.upright_deg)
        return ContactGeometry(
            z_mm - self.contact_mm + arm_mm * (1 - np.cos(turned)),
            x_mm - head.centre_mm + arm_mm * np.sin(turned),
            turned,
        )
