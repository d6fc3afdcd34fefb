"""Examples rendered from textured meshes, new ones in every step."""
