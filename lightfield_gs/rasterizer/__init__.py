"""The rasterizer: torch operators, their stages and work memory, ordinary images."""
