"""The embedded scenes: a furnished room, a landscape and a town, ray cast with exact poses and depth."""
