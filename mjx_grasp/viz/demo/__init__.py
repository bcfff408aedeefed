"""One grasp to show: from a mesh and an instruction to a film and a page."""
