"""A scene to the image of a panel: direct, view by view, or by whole views."""
