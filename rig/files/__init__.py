"""The files of a run: the journal, the run file compiled from it, processed and imported files."""
