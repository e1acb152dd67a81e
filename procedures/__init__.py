"""The procedures: one package for each kind of experiment."""
