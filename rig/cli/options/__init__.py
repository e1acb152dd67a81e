"""Options: a setting of a procedure on the command line, and groups that commands share."""
