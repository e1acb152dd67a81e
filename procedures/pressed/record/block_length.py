"""How long the blocks of the strips' samples are where a grip answers alarms: as short as the link
to the DAQ allows.

A block takes one or two exchanges with the DAQ, whatever its length. Where these take longer than
the block, the samples that are judged grow older and older, and an alarm comes when nothing can be
held any more.
"""

from __future__ import annotations

LENGTHS_S = (0.002, 0.005, 0.01, 0.02)
"""Lengths of a block in s that are chosen from."""
BEHIND_S = 0.05
"""Time in s for which a block has waited to be read, beyond which blocks are too short."""
FAR_BEHIND_S = 0.5
"""The same in the rest before the motion, which is not interrupted for a stall that may be made up
for: well before the DAQ's stream ends the run (`rig.run.streams.sample_stream`)."""
CATCH_UP_S = 0.3
"""Longest time in s that a motion waits for the samples to be read in time."""
READING_SHARE = 0.5
"""Largest share of a block's length that reading it is to take."""


def longer_block_s(block_s: float, read_s: float) -> float | None:
    """Return the length in s of blocks to be used instead of those of `block_s`, each of which took
    `read_s` to be read; None where those are the longest.

    >>> longer_block_s(0.002, 0.0029)
    0.01
    """
    longer = [one_s for one_s in LENGTHS_S if one_s > block_s]
    fitting = [one_s for one_s in longer if read_s <= READING_SHARE * one_s]
    return next(iter(fitting or longer[-1:]), None)
