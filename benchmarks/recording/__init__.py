"""What recordings cost, and whether a replay repeats them."""
