"""One setting, tried: what it costs and how far off it is.

Enters: a configuration, a change of it, work to be timed. Leaves: records of seconds, bytes and errors on one held-out truth.
Never enters: other settings, which are for those who compare.
"""
