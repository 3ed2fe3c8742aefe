"""Files that engines read textures from, and what is left of the textures in them.

Enters: basis textures. Leaves: files, the textures as an engine sees them, and how to tell the two apart. Lights never enter.
"""
