"""Crops and masks of fish that were found."""
