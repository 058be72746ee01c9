"""What goes wrong at sea, provoked: `make faults`, `make soak`."""
