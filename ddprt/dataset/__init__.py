"""Pairs of direct and indirect light on disk.

Enters: a scene, lightings, transport. Leaves: a folder of EXR pairs with a manifest, and arrays with lightings first.
Learning never enters.
"""
