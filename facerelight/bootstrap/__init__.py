"""The bootstrap: other people, rendered, from whom the statistics are learned. Only this room touches OpenGL."""
