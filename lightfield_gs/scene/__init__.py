"""Gaussians and cameras, in the axes of the world."""
