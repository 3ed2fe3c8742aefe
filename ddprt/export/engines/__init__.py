"""Engines: one binary file that all of them load, a shader that is printed in each one's language, and a loader for each.

Enters an export folder with the format "raw"; leaves a folder for each engine. Nothing of the model itself is looked at.
"""
