"""The commands of `stream-dmr`, one file per group."""
