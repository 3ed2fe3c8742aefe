"""Light that ddprt did not render, as a dataset that it can learn from.

Enters: pictures, tables of lights, measured numbers, a mesh where there is one. Leaves: the same folder that a bake leaves,
whose description says where the light comes from and what it lacks. Nothing is guessed without being told.
"""
