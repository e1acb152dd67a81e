"""Runs procedures: points, arming, stop requests. The bench is made safe first, data are saved
second.

`execute` is a run from connecting to its file; `procedure`, `context` and `points` are what the
author of a procedure uses. `streams` reads and watches sensors, `interlocks` watches contacts,
`locks` keeps others from the instruments, and `making_safe` acts where the run has died.
"""
