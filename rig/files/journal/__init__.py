"""The journal: the record of a run as it happens, append only, each record with a checksum."""
