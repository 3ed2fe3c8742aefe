"""Light on its way: Embree, the plan of effects, direct light, and the integrators.

Enters: a scene, its atlas, lightings, seeds. Leaves: direct and indirect irradiance in W/m². NumPy only; JAX never enters,
nor does any file. Modules of effects are imported when a plan calls for them.
"""
