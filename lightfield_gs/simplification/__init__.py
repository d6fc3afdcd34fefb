"""Scenes with fewer Gaussians: those that a panel does not show are dropped, those it cannot show apart are merged."""
