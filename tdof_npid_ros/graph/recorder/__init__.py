"""The recorder node, its snapshots of the parameters, and the lossless log that a plant waits for."""
