"""From the lengths of single frames to one length per fish with its interval."""
