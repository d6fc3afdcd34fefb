"""Posed photographs and their cameras, as arrays: reading only."""
