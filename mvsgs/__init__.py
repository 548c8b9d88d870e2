"""The command `mvsgs`: everything that a user starts, by one word."""
