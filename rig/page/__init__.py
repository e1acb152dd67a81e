"""The running bench in a browser or a terminal: follows journals, and asks a run to end.

A process of its own. It reads the journals of a results folder, takes none of their locks, and
believes the kernel about which process holds them. `view`, `ring`, `word` and `stop_course` are
values and rules without input or output; `watch` reads, `server` serves, `terminal` draws.
"""
