"""Photos: load, cut out, depth, and the network's picture of them."""
