"""The bootstrap: other people's faces, rendered or photographed, from which the statistics are learned. Only this
folder touches OpenGL."""
