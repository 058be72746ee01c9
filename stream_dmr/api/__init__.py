"""What `import stream_dmr` offers: measure, replay and open, and their results as typed rows."""
