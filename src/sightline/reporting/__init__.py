"""A run as a page: plots, the map, and the report that opens offline."""
