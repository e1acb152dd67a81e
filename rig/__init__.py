"""Controller for a tactile test bench: orchestration, recording, detection and its physics."""

__version__ = "0.1.0"
