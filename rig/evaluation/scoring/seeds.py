"""Separates the simulated trials on which detectors are tuned from those on which they are
reported.

Numbers that were chosen on some trials look better on these trials than on others. Seeds below a
million are for tuning, the others for reporting, and no score mixes them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Self

from pydantic import Field, model_validator

from rig.core.errors import ConfigurationError
from rig.core.settings import Settings

FIRST_REPORTING_SEED = 1_000_000
"""Seeds below this one are for tuning, this one and higher ones for reporting."""


class SeedRange(Settings):
    """Seeds from `first` up to `end`, without `end`."""

    first: int = Field(ge=0)
    """Lowest seed of the range, not below 0."""
    end: int
    """Seed after the last one."""

    @model_validator(mode="after")
    def _holds_a_seed(self) -> Self:
        if self.end <= self.first:
            raise ValueError(f"seeds {self}: the end must be above the first")
        return self

    def __str__(self) -> str:
        return f"{self.first}:{self.end}"

    def __len__(self) -> int:
        return self.end - self.first

    def seeds(self) -> range:
        """Return the seeds, ascending."""
        return range(self.first, self.end)

    def overlaps(self, other: SeedRange) -> bool:
        """Return whether any seed is in both ranges."""
        return self.first < other.end and other.first < self.end

    @property
    def reports(self) -> bool:
        """True if all of them are reporting seeds."""
        return self.first >= FIRST_REPORTING_SEED

    @property
    def tunes(self) -> bool:
        """True if all of them are tuning seeds."""
        return self.end <= FIRST_REPORTING_SEED


def seed_range(
    text: str, option: str = "--seeds", example: str = f"{FIRST_REPORTING_SEED}:1000100"
) -> SeedRange:
    """Return the range written as ``FIRST:END``, END excluded. Raises ConfigurationError for any
    other text, with an `example` of what the option takes.

    >>> len(seed_range("1000000:1000100"))
    100
    """
    match = re.fullmatch(r"\s*(\d{1,15})\s*:\s*(\d{1,15})\s*", text)
    if match is None or int(match[2]) <= int(match[1]):
        raise ConfigurationError(
            f"{option} {text}: not a range of seeds",
            f"write FIRST:END with END above FIRST, for example {example}",
        )
    return SeedRange(first=int(match[1]), end=int(match[2]))


def check_use(seeds: SeedRange, *, tuning: bool) -> None:
    """Raise ConfigurationError if seeds are used for what they are not reserved for."""
    if not (seeds.tunes or seeds.reports):
        raise ConfigurationError(
            f"seeds {seeds} lie on both sides of {FIRST_REPORTING_SEED}: below are trials for "
            "tuning, from there on trials for reporting, and a score never mixes them",
            "score each side by itself",
        )
    if seeds.tunes and not tuning:
        raise ConfigurationError(
            f"seeds {seeds} are reserved for tuning (below {FIRST_REPORTING_SEED}): a detector is "
            "not evaluated on trials on which its parameters were chosen",
            f"use seeds from {FIRST_REPORTING_SEED} on, or --tuning, which marks the tables",
        )
    if seeds.reports and tuning:
        raise ConfigurationError(
            f"seeds {seeds} are reserved for reporting (from {FIRST_REPORTING_SEED} on): nothing "
            "is tuned on them",
            f"use seeds below {FIRST_REPORTING_SEED}, or omit --tuning",
        )


def check_unseen(name: str, tuned_on: Sequence[SeedRange], seeds: SeedRange) -> None:
    """Raise ConfigurationError if a detector was tuned on some of the trials on which it is to be
    scored."""
    for seen in tuned_on:
        if seen.overlaps(seeds):
            raise ConfigurationError(
                f"{name} was tuned on seeds {seen} and is to be scored on {seeds}: it has seen "
                "some of these trials",
                "choose seeds that it has not seen",
            )
