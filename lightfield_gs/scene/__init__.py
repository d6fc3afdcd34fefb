"""Gaussians and cameras in world axes."""
