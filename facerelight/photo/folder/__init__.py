"""Many photographs: shared out among processes, written down row by row, gone on with after an interruption."""
