"""A page on this machine that takes a photo and shows it in the viewer."""
