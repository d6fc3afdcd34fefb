"""Networks that estimate depth: by transformers, and three that it does not read."""
