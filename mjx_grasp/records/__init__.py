"""Work that survives: atomic writing, archives, journals, provenance, settings, processes."""
