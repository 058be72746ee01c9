"""Status page, metrics and health of a run that is in progress."""
