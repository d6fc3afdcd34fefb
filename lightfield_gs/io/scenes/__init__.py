"""Files of 3D Gaussians: one module a format, and files.py for all."""
