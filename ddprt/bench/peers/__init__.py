"""Other libraries on the same problems, and the limits of the machine: `ddprt bench --peers`.

Enters: a scene's spectrum, sizes, a seed. Leaves: seconds and errors of everyone side by side, with shares of those limits.
Never enters: figures of another run or another machine.
"""
