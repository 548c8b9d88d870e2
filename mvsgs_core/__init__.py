"""MVS-GS core: arrays in, arrays out. Imports neither msgs, nodes nor zmq."""
