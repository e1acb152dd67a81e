"""Development of detectors on trials whose truth is known: simulation, scoring and training.
Nothing here takes part in a run."""
