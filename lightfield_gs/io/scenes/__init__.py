"""Files of 3D Gaussians, as arrays: one reader a format."""
