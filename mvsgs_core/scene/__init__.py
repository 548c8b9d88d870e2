"""The embedded scenes: a furnished room and a landscape, ray cast with exact poses and depth."""
