"""Whether the lengths of one live fish agree between photographs before a grid."""
