"""Follow candidates over frames and decide which are fish."""
