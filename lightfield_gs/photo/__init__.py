"""Photos: loading, cut-outs, depth, and the network's Gaussians."""
