"""The run file: HDF5 with NeXus attributes, compiled from the journal and read back."""
