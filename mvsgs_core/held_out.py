"""Which frames are held out: chosen before a run by their index alone, so that they are the same whatever is built.

The tracker makes no keyframe of them where it can take the next frame instead; the evaluator scores the map on those
that became none.
"""

HELD_OUT_EVERY = 5  # frames


def is_held_out(index: int) -> bool:
    """Whether the frame of this index of the stream (from 0) is kept out of the map."""
    return index % HELD_OUT_EVERY == 0
