"""Fits a scene to posed photographs."""
