"""Photographs of one live fish before a grid: do their lengths agree?"""
