"""Which random trials a detector may be tuned on, and on which it is reported.

Numbers that were chosen on some trials are flattered by those trials. Seeds below a million are
for tuning, those from there on for reporting, and no score mixes them.
"""

from __future__ import annotations

import re
from typing import Self

from pydantic import Field, model_validator

from rig.core.errors import ConfigurationError
from rig.core.settings import Settings

FIRST_REPORTING_SEED = 1_000_000
"""Seeds below are for tuning, this one and those above for reporting."""


class SeedRange(Settings):
    """Seeds from `first` up to, but without, `end`."""

    first: int = Field(ge=0)
    end: int

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
        """The seeds, ascending."""
        return range(self.first, self.end)

    def overlaps(self, other: SeedRange) -> bool:
        """Whether a seed is in both."""
        return self.first < other.end and other.first < self.end

    @property
    def reports(self) -> bool:
        """Whether all of them are reporting seeds."""
        return self.first >= FIRST_REPORTING_SEED

    @property
    def tunes(self) -> bool:
        """Whether all of them are tuning seeds."""
        return self.end <= FIRST_REPORTING_SEED


def seed_range(text: str) -> SeedRange:
    """A range written as ``FIRST:END``, Python's way; ConfigurationError for anything else."""
    match = re.fullmatch(r"\s*(\d{1,15})\s*:\s*(\d{1,15})\s*", text)
    if match is None or int(match[2]) <= int(match[1]):
        raise ConfigurationError(
            f"--seeds {text}: is no range of seeds",
            f"write FIRST:END with END above FIRST, for example {FIRST_REPORTING_SEED}:1000100",
        )
    return SeedRange(first=int(match[1]), end=int(match[2]))


def check_use(seeds: SeedRange, *, tuning: bool) -> None:
    """ConfigurationError where seeds are scored for what they are not for."""
    if not (seeds.tunes or seeds.reports):
        raise ConfigurationError(
            f"seeds {seeds} lie on both sides of {FIRST_REPORTING_SEED}: below are trials for "
            "tuning, from there on trials for reporting, and a score never mixes them",
            "score each side by itself",
        )
    if seeds.tunes and not tuning:
        raise ConfigurationError(
            f"seeds {seeds} are for tuning (below {FIRST_REPORTING_SEED}): what was chosen on "
            "them cannot be reported on them",
            f"take seeds from {FIRST_REPORTING_SEED} on, or --tuning for tables that say so",
        )
    if seeds.reports and tuning:
        raise ConfigurationError(
            f"seeds {seeds} are for reporting (from {FIRST_REPORTING_SEED} on): nothing is tuned "
            "on them",
            f"take seeds below {FIRST_REPORTING_SEED}, or leave --tuning out",
        )


def check_unseen(name: str, tuned_on: SeedRange | None, seeds: SeedRange) -> None:
    """ConfigurationError where a detector was tuned on some of the trials it is scored on."""
    if tuned_on is not None and tuned_on.overlaps(seeds):
        raise ConfigurationError(
            f"{name} was tuned on seeds {tuned_on} and is to be scored on {seeds}: it has seen "
            "some of these trials",
            "choose seeds that it has not seen, or --tuning for tables that say so",
        )
