"""Compare measured lengths with known lengths."""
