"""From a fitted mesh to millimetres."""
