"""What is said of a command line that cannot run."""

from __future__ import annotations


class GraphError(ValueError):
    """A graph that cannot run; the message says why and what would be valid."""
