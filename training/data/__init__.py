"""Multi-view images of objects: reading, checking, caching, sampling, cropping."""
