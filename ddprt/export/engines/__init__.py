"""Engines: one binary file that all of them load, a shader printed in each one's language, a loader and notes for each.

Enters: an export folder with the format "raw". Leaves: a folder for each engine. The model itself never enters.
"""
