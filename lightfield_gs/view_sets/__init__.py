"""Sets of views in files, the left-most camera's first: quilts, folders, rows of light fields, and the frames of videos
and animations."""
