"""Export results, one file per kind of format."""
