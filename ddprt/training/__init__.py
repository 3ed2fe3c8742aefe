"""One loop that trains whatever can be trained.

Enters: a problem (pure functions of parameters, data and a key), its data, a schedule. Leaves: the parameters that were best on
the validation data, and how they came about. Scenes, files of datasets and metrics never enter.
"""
