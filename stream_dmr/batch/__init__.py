"""Many videos from a manifest, on all cores or on a Ray cluster, as one data set."""
