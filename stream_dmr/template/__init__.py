"""Template meshes with their joints and keypoints, and the bundled species."""
