"""Report, review, watch and fleet: pages and one server."""
