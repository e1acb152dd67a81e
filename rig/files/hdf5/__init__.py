"""HDF5 and NeXus: writing that survives a full disk, reading that trusts no declared size."""
