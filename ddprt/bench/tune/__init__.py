"""The setting that keeps within limits: `ddprt tune`.

Enters: a configuration with [tune], trials as they come in. Leaves: the best plan, what it reached, and how sure that is.
Never enters: grids tried whole; each trial is chosen by what the ones before it say.
"""
