"""glTF back out: the scene as it was learned from, with the lightmap's coordinates as its second set.

Enters: a model, and the scene of its run where there is one. Leaves: scene.glb. Nothing of what was learned is in it but a
picture of one lighting, if asked.
"""
