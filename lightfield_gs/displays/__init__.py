"""Displays that are connected to this computer, and the calibrations of those that have lenses."""
