"""Panels, the fan of cameras behind their views, and the picture that an eye sees."""
