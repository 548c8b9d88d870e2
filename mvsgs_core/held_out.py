"""Which frames are held out: chosen before a run by their index alone, so that they are the same whatever is built.

The tracker makes no keyframe of them where it can take the next frame instead; the evaluator scores the map on those
that became none.
"""

HELD_OUT_EVERY = 5  # frames


def is_held_out(index: int) -> bool:
    """Whether the frame of this index of the stream (from 0) is kept out of the map.

    The first frame never is: it's the first view that a user gives, and no frame before it shows what only it sees.
    Nor is a frame of an earlier stream (below 0, kept_map.py), of which nothing is scored.
    """
    return index > 0 and index % HELD_OUT_EVERY == 0
