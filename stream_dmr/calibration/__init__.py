"""The lens of a camera and the reference plane."""
