"""A recording computed anew from any stage, and compared with what was recorded."""
