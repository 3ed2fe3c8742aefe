"""What stays still.

Enters: a name of the library or a file (glTF, OBJ, PLY, STL) and what a user's own code holds as arrays; every one of them
passes `checks.checked`. Leaves: a `Scene`: triangles that face the free space, diffuse materials in linear Rec.709, and
notes on all that was repaired or ignored. Lights, rays, random numbers and JAX never enter.
"""
