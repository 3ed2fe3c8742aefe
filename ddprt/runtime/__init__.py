"""A trained model at work.

Enters: a dataset to learn from, then measured light or lightings. Leaves: lightmaps, and a self-contained file. Reports and
exports never enter.
"""
