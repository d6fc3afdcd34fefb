"""Frames in a row for a panel: where the cameras stand in each, what is drawn, and the files that it goes to."""
