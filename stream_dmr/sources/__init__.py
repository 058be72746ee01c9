"""Videos, pictures, cameras and positions."""
