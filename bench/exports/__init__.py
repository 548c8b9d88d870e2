"""Every export opened by programs that are not ours: counted, rendered where they can, compared with our own render."""
