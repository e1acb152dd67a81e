"""The small network of the logic ``rig``: one hidden layer, weights as plain numbers.

Its parameters are a readable JSON file in this package that says from which simulated trials they
were learned and by which command; ``rig train`` writes it again.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from rig.core.settings import Settings

Reals = NDArray[np.float64]

OUTPUTS = ("slip", "roll")
FILE = "rig.json"


class Network(Settings):
    """x / (1 + |x|) of weighted sums of the inputs, weighted again into the log odds of slip and
    roll."""

    name: str
    inputs: tuple[str, ...] = Field(min_length=1)
    """Names of the features, in order (`rig.detector.kernel`)."""
    hidden: tuple[tuple[float, ...], ...] = Field(min_length=1)
    """(units, inputs + 1); the last number of a row is its bias."""
    output: tuple[tuple[float, ...], ...] = Field(min_length=len(OUTPUTS), max_length=len(OUTPUTS))
    """(slip and roll, units + 1), the same way."""
    first_seed: int
    last_seed: int
    """Of the simulated trials it has seen; scoring refuses them."""
    trained_by: str
    """Command, program version and data."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        wanted = {len(self.inputs) + 1}
        if {len(row) for row in self.hidden} != wanted:
            raise ValueError(
                f"hidden rows must have {wanted.pop()} numbers, one for each of the "
                f"{len(self.inputs)} inputs and a bias"
            )
        if {len(row) for row in self.output} != {len(self.hidden) + 1}:
            raise ValueError(
                f"output rows must have {len(self.hidden) + 1} numbers, one for each of the "
                f"{len(self.hidden)} hidden units and a bias"
            )
        return self

    def weights(self) -> tuple[Reals, Reals]:
        """Hidden (inputs + 1, units) and output weights (2, units + 1) as arrays."""
        return np.ascontiguousarray(np.array(self.hidden).T), np.array(self.output)


def trained_network() -> Network:
    """The network of this version, from its file in the package."""
    return Network.model_validate_json(files(__package__).joinpath(FILE).read_bytes())
