"""A camera watched all day: its source, the state of its targets, what is kept and published."""
