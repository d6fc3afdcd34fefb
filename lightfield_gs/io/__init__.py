"""Files in and out: Gaussians (.ply), images, photos, YAML."""
