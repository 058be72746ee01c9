"""From a fitted mesh to millimetres on the reference plane, with uncertainty."""
