"""Fitting: a scene of Gaussians optimised from photographs with known cameras (Kerbl et al. 2023)."""
