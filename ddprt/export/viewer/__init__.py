"""The viewer: a model in a browser, lit live.

Enters: a model, and held-out lightings of its dataset if they are wanted. Leaves: one HTML file without a server or a network,
or the same behind a local address. Its program is `src/`, bundled with three.js into `viewer.js` by `make viewer`; Node is
needed for that alone.
"""
