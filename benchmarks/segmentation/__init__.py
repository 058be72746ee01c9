"""How well fish are found, followed and segmented."""
