"""Recognition from one photograph a person: exemplars under every light, subspaces, classifiers and their
measurement."""
