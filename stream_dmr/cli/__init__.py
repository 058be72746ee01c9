"""The commands of `stream-dmr`: one file per command, shared options, terminal display."""
