"""Compare measured lengths with known ones."""
