"""What is known of a caught fish beside its length: what became of it, and its species."""
