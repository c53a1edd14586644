"""Numerics that know nothing of faces: Gaussians and their factors, mixtures, kernels, shrinkage, samples and a
blur."""
