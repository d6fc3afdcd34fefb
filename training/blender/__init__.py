"""Views of meshes for training, rendered with Blender: plan.py says from where, render.py, inside Blender, renders."""
