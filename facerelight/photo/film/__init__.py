"""Films: a face followed over time, frames as evidence of one person in one light, lamps that move, and files with
sound."""
