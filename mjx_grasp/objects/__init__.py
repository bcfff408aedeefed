"""Objects: catalogue, meshes, parametric stand-ins, convex pieces, mass, resting poses."""
