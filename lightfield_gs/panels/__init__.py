"""Panels, the fan of cameras behind their views, and what an eye sees of them."""
