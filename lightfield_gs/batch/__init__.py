"""Batches of inputs: their items, the manifest of results, and the processes that work on them."""
