"""One run: configuration, inputs, the chain of nodes, outputs, recovery."""
