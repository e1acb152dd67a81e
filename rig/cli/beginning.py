"""What a command line begins before it has been understood: its simulated bench.

To import what understands a command line takes as long as to import what a simulated bench is made
of. Nothing is known here but the words: where they say that a procedure is to run and nothing says
that it is not on a simulated bench, one is begun, and told later how it is to be. A command line
that turns out to mean something else leaves it, and it ends by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rig.core.entry_points import PROCEDURES, names
from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from rig.bench.bench import RunningBench


def begin_bench(arguments: Sequence[str]) -> RunningBench | None:
    """The simulated bench of a procedure; None where a command line has no use for one."""
    asked = next((word for word in arguments if not word.startswith("-")), None)
    if asked not in names(PROCEDURES):
        return None
    from rig.run.bench_selector import begin_simulated, bench_file

    elsewhere = any(word.startswith(("--bench", "--help")) for word in arguments)
    if elsewhere or bench_file(None) is not None:
        return None
    try:
        return begin_simulated()
    except ConfigurationError:  # the command says so where it turns out to need one
        return None
