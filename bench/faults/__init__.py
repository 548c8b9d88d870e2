"""The parts of `bench.faults`, one kind of fault a file; each has `measure(quick: bool) -> list[Row]`."""
