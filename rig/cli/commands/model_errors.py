"""Turns errors of the skin model and the detectors into one-line errors of a command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rig.core.errors import ConfigurationError, RigError


@contextmanager
def model_errors(remedy: str | None = None) -> Iterator[None]:
    """Report invalid values as a ConfigurationError, and contact steps without a solution as a
    RigError, each of one line.

    `remedy` is the hint for a step without a solution.
    """
    from pydantic import ValidationError

    from rig.physics.contact.stepper import ConvergenceError

    try:
        yield
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, "options") from error
    except ConvergenceError as error:
        raise RigError(str(error), remedy) from error
    except ValueError as error:
        raise ConfigurationError(str(error)) from error
