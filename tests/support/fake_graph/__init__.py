"""A small graph of nodes that do nothing but pass numbers on, to test launching without the real stages."""
