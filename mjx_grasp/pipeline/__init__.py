"""From an object on the table to an object held up: one controller over all stages."""
