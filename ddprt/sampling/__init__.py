"""What is drawn: lightings for the dataset, and points where direct light is measured.

Enters: a scene, a distribution, a seed. Leaves: lightings and samples, addressed by index. Rays never enter: how free a
position is comes in as a function.
"""
