"""How accurate lengths are on simulated scenes, and what limits it."""
