"""Table 1 of the paper: every method on the same simulated fish. See __main__.py."""
