"""Frames for a panel: the rig of each frame, the rendering, and the output files."""
