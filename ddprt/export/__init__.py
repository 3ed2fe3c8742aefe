"""What engines load.

Enters: a model. Leaves: textures, matrices and a manifest that says how to decode them. Learning never enters.
"""
