"""How fast the fit is: `make bench`."""
