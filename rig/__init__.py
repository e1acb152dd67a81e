"""Controller for a tactile test bench: orchestration, recording, detection and its physics."""

from rig.core import unreadable_packages

__version__ = "0.1.0"

# Before anything else is imported: pydantic and numba look for plug-ins while they are.
unreadable_packages.tolerate()
