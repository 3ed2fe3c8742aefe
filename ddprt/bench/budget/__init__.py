"""The error of one model, taken apart by its causes: `ddprt eval --budget`.

Enters: a model, its dataset, bakes of our own. Leaves: shares of the squared error that add up to it, and the knob to turn
first. Never enters: other settings than the model's, but for one that is turned to see whether the advice holds.
"""
