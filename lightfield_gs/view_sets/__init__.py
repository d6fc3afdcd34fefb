"""Sets of views in files: quilts, folders, light fields and frames of videos; the left-most camera is first."""
