"""The small network of the logic ``rig``: one hidden layer, its weights stored as plain numbers.

The parameters are a readable JSON file in this package. It records on which simulated trials they
were trained and by which command. ``rig train`` writes such a file.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from rig.core.settings import Settings

Reals = NDArray[np.float64]

OUTPUTS = ("slip", "roll")
FILE = "rig.json"


MODEL_TRIALS = "trials of the skin model"


class Network(Settings):
    """Weights of a network with one hidden layer.

    A hidden unit returns x / (1 + |x|) of the weighted sum x of its inputs. The weighted sums of
    the units are the log odds of a slip and of a roll.
    """

    name: str
    """Name of the network, for messages and files."""
    inputs: tuple[str, ...] = Field(min_length=1)
    """Names of the inputs, in order (`rig.detector.kernel.INPUTS`)."""
    hidden: tuple[tuple[float, ...], ...] = Field(min_length=1)
    """Hidden weights (units, inputs + 1); the last number of each row is its bias."""
    output: tuple[tuple[float, ...], ...] = Field(min_length=len(OUTPUTS), max_length=len(OUTPUTS))
    """Output weights (2, units + 1) for slip and roll; the last number of each row is its bias."""
    first_seed: int
    """First seed of the simulated trials on which it was trained."""
    last_seed: int
    """Last seed of the simulated trials on which it was trained. Scoring on these trials is
    refused."""
    trained_by: str
    """Command and program version of the training."""
    trained_on: str = MODEL_TRIALS
    """Number and source of the trials on which it was trained."""

    @model_serializer(mode="wrap")
    def _as_before(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what networks of earlier versions do not state.

        Their fingerprint, which is in the names of processed files, thus remains the same.
        """
        plain: dict[str, Any] = serialize(self)
        if self.trained_on == MODEL_TRIALS:
            del plain["trained_on"]
        return plain

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
        """Return the hidden weights (inputs + 1, units) and the output weights (2, units + 1) as
        arrays."""
        return np.ascontiguousarray(np.array(self.hidden).T), np.array(self.output)


def trained_network() -> Network:
    """Return the network of this version, read from its file in the package."""
    return Network.model_validate_json(files(__package__).joinpath(FILE).read_bytes())
