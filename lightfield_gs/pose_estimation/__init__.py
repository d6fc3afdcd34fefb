"""Cameras of photographs and films that come without any: frames are chosen, and poses are found."""
