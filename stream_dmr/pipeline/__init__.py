"""Runs and replays: configuration, sessions, outputs, folders."""
