"""Train the U-Net."""
