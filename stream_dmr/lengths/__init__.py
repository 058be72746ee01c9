"""From frames to one length, species and fate per fish."""
