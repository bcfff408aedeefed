"""Files that survive: atomic writing, archives, provenance, settings, tables."""
