"""Encode scenes as images of a panel: by sub-pixels directly, view by view, or by whole views."""
