"""Where fish are in a frame: detection, tracking, masks, the network, its training."""
