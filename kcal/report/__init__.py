"""Pictures, pages and the map."""
